"""The seam between motion and force: the protocol `Method`, its input and its result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from bench.methods.force_mixture import ForceMixture
from synth.arrays import Floats, Map, Mask
from synth.flow.recording.frame_motion import FrameMotion as FrameMotion
from synth.job.types import MembraneState, PronyTerms

Field = Map  # (H, W, ...) on the pixels that flow is computed on


@dataclass(frozen=True)
class MethodContext:
    """A recording's constants, for the pixels that flow is computed on."""

    tissue: Mask
    """(H, W)."""
    scale_mm_per_px: float
    young_kpa: float | None
    """None: unknown."""
    membrane: MembraneState = "unknown"
    poisson: tuple[float, float] = (0.4, 0.49)
    """Range of the tissue's Poisson's ratio."""
    young_uncertainty: float = 0.0
    """Relative standard uncertainty of `young_kpa`."""
    living: bool = True
    """Whether the tissue may move by heart and breath; False: ex vivo, or a phantom."""
    recovered_by: str = ""
    """Estimator and version of the motion; empty: unknown."""
    alpha: tuple[float, float] = (-20.0, 2.0)
    """Range of the exponent of Ogden's law, for motion beyond the linear range."""
    membrane_mn_per_mm: tuple[float, float] | None = None
    """Range of the membrane's stiffness, its thickness times its Young's modulus; None: unknown."""
    relaxation: PronyTerms = ()
    """Lost shares of the stiffness and times [s]; `young_kpa` and the membrane's are then instantaneous."""

    def __post_init__(self) -> None:
        """Makes `tissue` read-only: methods share it."""
        object.__setattr__(self, "tissue", self.tissue.view())
        self.tissue.flags.writeable = False


@dataclass(frozen=True)
class ForceEstimate:
    """A method's estimate of one frame."""

    force_mn: Floats
    """(3,) force on the tissue in camera axes [mN]; of magnitudes alone in x, with NaN for y and z."""
    density: Field | None = None
    """(H, W) magnitude of the force density on the rest frame's pixels [kPa], for the force maps."""
    low_mn: float = math.nan
    """Lower end of the 90% prediction interval of the force's magnitude; NaN: none."""
    high_mn: float = math.nan
    """Upper end."""
    likely: ForceMixture | None = None
    """Probability distribution of the force, for a fusion of methods; without the uncertainty of E."""
    expected_mn: float = math.nan
    """Estimate of the magnitude, with one camera its mean over what is likely: more than that of `force_mn`,
    which is without what the motion does not show. NaN: that of `force_mn`."""

    @property
    def size_mn(self) -> float:
        """The force's magnitude: `expected_mn`, else that of `force_mn`; NaN if neither is known."""
        if np.isfinite(self.expected_mn):
            return self.expected_mn
        known = self.force_mn[np.isfinite(self.force_mn)]
        return float(np.linalg.norm(known)) if len(known) else math.nan

    def scale_by(self, factor: float) -> ForceEstimate:
        """That of a force `factor` times as large."""
        return replace(
            self,
            force_mn=factor * self.force_mn,
            density=None if self.density is None else np.float32(factor) * self.density,
            low_mn=factor * self.low_mn,
            high_mn=factor * self.high_mn,
            likely=None if self.likely is None else self.likely.scale_by(factor),
            expected_mn=factor * self.expected_mn,
        )


def widen_small_forces(estimates: Sequence[ForceEstimate], share: float = 0.05) -> list[ForceEstimate]:
    """Extends the intervals of a video's small forces, below a share of its largest one, to 0 and that share.

    After a press tissue creeps without a force, and a slight touch moves it less than flow resolves. The
    share is set by hand; docs/results/learn/foreign has the coverage on videos of other simulators.
    """
    least = share * max((estimate.size_mn for estimate in estimates), default=0.0)
    return [
        replace(estimate, low_mn=0.0, high_mn=max(estimate.high_mn, least))
        if estimate.size_mn < least
        else estimate
        for estimate in estimates
    ]


class Method(Protocol):
    """A force estimator: from the tissue's motion in a frame to the force on it.

    The simplest one takes the mean length of the motion for a force [mN]:

        def mean_motion(frame, scene, picture):
            moved_mm = scene.scale_mm_per_px * np.linalg.norm(frame.flow[scene.tissue], axis=1)
            return ForceEstimate(np.array([moved_mm.mean(), np.nan, np.nan]))

    A method with `is_elastic` True takes the tissue for elastic: where relaxation is stated, it is
    applied to its forces afterwards. A method with a list of strings `notes` has them shown in the
    report, `warnings` as findings if it leads.
    One that has to see the whole video first is `Revising`.
    """

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        """Force of one frame; frames come in order.

        Args:
            frame: motion from the rest frame: `flow` (H, W, 2) px and its `confidence` (H, W) in 0..1; of a
                recording with a right or a depth camera also `motion`, in three dimensions [mm].
            scene: the recording's constants.
            picture: whether `density` is requested.
        """
        ...


@runtime_checkable
class Revising(Protocol):
    """A method that estimates all frames again at the end of a video."""

    def revise(self, contact_free: Mask) -> list[ForceEstimate]:
        """An estimate of each frame since the start of the recording, without `density`.

        `contact_free`: (T,) whether the tissue is known to be without contact.
        """
        ...
