"""Shapes of the networks: what a model's card states of them, without PyTorch."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from learn.data.grid import CHANNELS
from synth.job.types import Positive, Section


class Shape(Section):
    """Inputs and output of a network; each kind of network adds its own settings."""

    output: Literal["magnitude", "vector"] = "vector"
    """`magnitude`: force density ≥ 0; `vector`: its x, y, z in camera axes."""
    confidence: bool = False
    """Whether a sixth channel holds the flow's confidence."""
    depth: bool = False
    """Whether channels hold stereo motion along the optical axis, with `confidence` also its confidence."""
    membrane: bool = False
    """Whether a last channel holds the state of the membrane (pia): stripped, unknown or intact."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the input channels, in order."""
        along = ("dz", *["confidence of dz"] * self.confidence)
        flow = (*CHANNELS, *["confidence"] * self.confidence)
        return (*flow, *along * self.depth, *["membrane"] * self.membrane)

    @property
    def displacements(self) -> int:
        """Components of the displacement."""
        return 3 if self.depth else 2

    @property
    def axes(self) -> list[int]:
        """Numbers of the channels that hold the displacement's components."""
        return [k for k, name in enumerate(self.channels) if name in ("dx", "dy", "dz")]

    @property
    def components(self) -> int:
        return 1 if self.output == "magnitude" else 3

    @property
    def divisor(self) -> int:
        """Number by which the cells along the grid's edge must be divisible."""
        return 1


class Architecture(Shape):
    """The shape of the convolutional network of `d2fnet`."""

    width: Annotated[int, Field(ge=4, le=512, multiple_of=4)] = 32
    """Channels of the first level; each level doubles them."""
    levels: Annotated[int, Field(ge=1, le=5)] = 4
    """Number of halvings after the stem."""
    stem: Literal[1, 2, 4] = 1
    """Stride of the first convolution; 4 makes the network fast enough for live use."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    relative: bool = False
    """Whether displacement is divided by the frame's largest, and the map multiplied by it: twice the motion
    is then twice the force, as in linear elasticity, by construction."""

    @property
    def divisor(self) -> int:
        return int(self.stem * 2**self.levels)


class LinearShape(Shape):
    """The shape of the linear map of `ridge`."""

    cells: Annotated[int, Field(ge=2, le=64)] = 16
    """Blocks of cells along the grid's edge, between whose means of motion and force the map is."""
    strength: Positive = 1e-3
    """Of the penalty on the map's square, over the mean square of what a block sees over all frames."""

    @property
    def divisor(self) -> int:
        return self.cells
