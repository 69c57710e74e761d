"""Networks by their names: ours, and those of other packages."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from learn.network.shape import Architecture, LinearShape, Shape
from synth.errors import UserError, as_user_error
from synth.plugins import Registry

if TYPE_CHECKING:
    from torch import Tensor, nn

DEFAULT = "d2fnet"


@dataclass(frozen=True)
class Network:
    """A kind of network, by which one is made, trained, stored, exported and used."""

    shape: type[Shape]
    """Of its settings, the section `arch` of a training."""
    build: Callable[[Any], nn.Module]
    """The untrained network of a shape: (B, C of `Shape.channels`, N, N) → (B, 1|3, N, N) in units of
    `Scales.target`, 0 outside the mask. It must be one that `torch.onnx.export` can trace."""
    solve: Callable[[Any, Iterable[tuple[Tensor, Tensor]]], None] | None = None
    """Sets a network's weights from batches of input and target (B, 1|3, N, N), in the units of `build`, once
    an epoch; None: they are found by gradient descent on the loss."""


def d2fnet() -> Network:
    """The convolutional network of Heraoui et al."""

    def build(shape: Architecture) -> nn.Module:
        from learn.network.d2fnet import D2FNet

        return D2FNet(shape)

    return Network(Architecture, build)


def ridge() -> Network:
    """A linear map, fitted by ridge regression."""

    def build(shape: LinearShape) -> nn.Module:
        from learn.network.ridge import LinearMap

        return LinearMap(shape)

    def solve(network: Any, batches: Iterable[tuple[Tensor, Tensor]]) -> None:
        from learn.network.ridge import solve

        solve(network, batches)

    return Network(LinearShape, build, solve)


_OWN = {name: f"{__name__}:{name}" for name in (DEFAULT, "ridge")}
NETWORKS = Registry("sulcus.networks", "network", "network", _OWN)
"""An entry point is a `Network`, or a function without arguments that returns one. It should import PyTorch
in `build` only: to use a trained network none is needed."""


def load_network(name: str) -> Network:
    """The kind of network of a name. UserError if there is none, or its package can't be loaded."""
    kind = NETWORKS.load(name)
    if not isinstance(kind, Network):
        raise UserError(f"{NETWORKS.label(name)}: is {type(kind).__name__}, expected learn.Network")
    return kind


def build(name: str, shape: Shape) -> nn.Module:
    """The untrained network of a kind and shape. UserError for any exception of a plug-in."""
    kind = load_network(name)
    if name in NETWORKS.builtin:
        return kind.build(shape)
    with as_user_error(NETWORKS.label(name)):
        return kind.build(shape)
