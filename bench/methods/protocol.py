"""What a method is: displacement to force, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bench.methods.force_mixture import ForceMixture
from synth.flow.stereo.track import Moved
from synth.job.types import MembraneState

Field = NDArray[np.float32]
"""(H, W, ...) on the pixels that flow is computed on."""


@dataclass(frozen=True)
class MethodContext:
    """What stays the same over a recording, on the pixels flow is computed on."""

    tissue: NDArray[np.bool_]
    """(H, W)."""
    scale_mm_per_px: float
    young_kpa: float | None
    membrane: MembraneState = "unknown"
    """What is known of the tissue's."""
    poisson: tuple[float, float] = (0.4, 0.49)
    """Between which its Poisson's ratio lies."""
    young_uncertainty: float = 0.0
    """Relative standard uncertainty of `young_kpa`."""

    def __post_init__(self) -> None:
        """One method can't change what the others are told."""
        object.__setattr__(self, "tissue", self.tissue.view())
        self.tissue.flags.writeable = False


@dataclass(frozen=True)
class ForceEstimate:
    """A method's estimate of one frame."""

    force_mn: NDArray[np.float64]
    """(3,) force on the tissue in camera axes [mN]; a method of magnitudes only puts it into x, rest NaN."""
    density: Field | None = None
    """(H, W) size of the force density on the rest frame's pixels [kPa], for the pictures."""
    low_mn: float = math.nan
    """Lower end of the 90% interval of the force's size; NaN of a method that knows none."""
    high_mn: float = math.nan
    """Upper end."""
    likely: ForceMixture | None = None
    """What else the force may be, for whoever weighs several methods; the error by E is not in it."""

    @property
    def size_mn(self) -> float:
        return float(np.sqrt(np.nansum(self.force_mn**2)))


def widen_small_forces(estimates: Sequence[ForceEstimate], share: float = 0.05) -> list[ForceEstimate]:
    """Estimates of a video, intervals of those below a share of the largest force reaching down to 0.

    Tissue creeps: what a press leaves behind moves without a force. The share, a twentieth, is set by hand;
    docs/results/learn/foreign has what intervals then hold on videos of other simulators and renderers.
    """
    largest = max((one.size_mn for one in estimates), default=0.0)
    return [replace(one, low_mn=0.0) if one.size_mn < share * largest else one for one in estimates]


class Method(Protocol):
    """Displacement to force, frame by frame. Its `notes: list[str]`, if it has any, are read at the end."""

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """Force of one frame.

        Args:
            flow: (H, W, 2) px from the rest frame.
            confidence: (H, W) in 0..1.
            scene: the recording's constants.
            picture: whether `density` is wanted.
        """
        ...


@runtime_checkable
class Uses3D(Protocol):
    """A method that also uses motion in three dimensions, where a recording has a right or a depth camera."""

    def in_space(
        self, flow: Field, confidence: Field, moved: Moved, scene: MethodContext, picture: bool
    ) -> ForceEstimate:
        """As a `Method`; `moved`: motion [mm] in camera axes and its standard deviation, (H, W, 3) each."""
        ...


@runtime_checkable
class Revising(Protocol):
    """A method that, once a video is over, estimates all its frames anew."""

    def revise(self, contact_free: NDArray[np.bool_]) -> list[ForceEstimate]:
        """An estimate for each frame since the recording began; no `density` is needed.

        `contact_free`: (T,) whether nothing touches the tissue, as far as is known.
        """
        ...


@runtime_checkable
class FusedEstimate(Protocol):
    """A method whose estimate is made of those of others in the table."""

    @property
    def parts(self) -> tuple[str, ...]:
        """Their names; the first's `density` is the picture."""
        ...

    def fuse(
        self, answers: Sequence[Mapping[str, ForceEstimate]], scene: MethodContext, eyes: int
    ) -> list[ForceEstimate]:
        """The force of each of a video's frames from the others' estimates; `eyes`: 1 monocular, 2 stereo."""
        ...
