"""The interface of flow estimators, and their creation by name."""

from __future__ import annotations

from typing import Protocol

from synth.arrays import Map, Mask, Pixels
from synth.errors import as_user_error
from synth.formats import motion_version
from synth.plugins import ESTIMATORS, check_answer


class Estimator(Protocol):
    """Displacement of material points between two pictures."""

    def flow(
        self, rest: Pixels, now: Pixels, rest_usable: Mask, now_usable: Mask, initial: Map | None = None
    ) -> tuple[Map, Map]:
        """Flow from `rest` to `now` at the pixel centres of `rest`.

        Args:
            rest: (H, W, 3) uint8, sRGB.
            now: (H, W, 3) uint8, sRGB.
            rest_usable: (H, W), False where `rest` shows no tissue (tool, glare, outside the tissue).
            now_usable: (H, W), the same on the pixels of `now`.
            initial: (H, W, 2) px, the flow to start from; None: zero.

        Returns:
            Flow (H, W, 2) float32 px, finite everywhere, and confidence (H, W) float32 in 0..1.
        """
        ...


def name_backend(backend: str | Estimator) -> str:
    """The name of an estimator, or of its class."""
    return backend if isinstance(backend, str) else type(backend).__qualname__


def name_motion(backend: str | Estimator) -> str:
    """Estimator and version of motion that is recovered now, `tvl1 4-0a1b2c3d`, as models' cards hold it."""
    return f"{name_backend(backend)} {motion_version()}"


class CheckedEstimator:
    """A third-party estimator whose exceptions and invalid results become a `UserError` that names it."""

    def __init__(self, estimator: Estimator, label: str) -> None:
        self._estimator, self._label = estimator, label

    def flow(
        self, rest: Pixels, now: Pixels, rest_usable: Mask, now_usable: Mask, initial: Map | None = None
    ) -> tuple[Map, Map]:
        """See `Estimator`."""
        with as_user_error(self._label):
            flow, confidence = self._estimator.flow(rest, now, rest_usable, now_usable, initial)
        size = rest.shape[:2]
        checked_confidence = check_answer(self._label, "confidence", confidence, size, (0, 1))
        return check_answer(self._label, "flow", flow, (*size, 2)), checked_confidence


def create(backend: str | Estimator) -> Estimator:
    """An estimator: built in, from the entry-point group `sulcus.flow`, or the object passed.

    Raises UserError if no estimator has that name, or the package of a plug-in does not load.
    """
    if not isinstance(backend, str):
        kind = type(backend)
        is_builtin = kind.__module__.startswith("synth.")
        return backend if is_builtin else CheckedEstimator(backend, f"flow.backend {kind.__qualname__}")
    estimator: Estimator = ESTIMATORS.load(backend)
    is_builtin = backend in ESTIMATORS.builtin
    return estimator if is_builtin else CheckedEstimator(estimator, ESTIMATORS.label(backend))
