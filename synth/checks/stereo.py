"""What must hold between the two eyes of a stereo sequence: flows, depths and motion are stored apart."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.checks import optics
from synth.checks.measure import Measure
from synth.dataset.store import Sequence
from synth.render.camera import camera as cameras

Floats = NDArray[np.float64]

_EVERY = 9  # rest pixels from one that is looked at to the next
_HALF_PX = 0.008  # a flow below 32 px in half floats is rounded by so much


def stereo(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Both eyes' flows and depths, rest disparity and motion in space say the same [px, relative]."""
    needed = {"motion", "disparity", "depth"}
    if any(name not in sequence for name in needed):
        return
    left, right = optics.camera_of(sequence), right_of(sequence)
    tissue, rest_depth = sequence["tissue"][:], sequence["depth"][0].astype(np.float64)
    core = cv2.erode(
        (tissue & ~sequence["tool"][0]).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0
    )
    rows, columns = (at[::_EVERY] for at in np.nonzero(core & (rest_depth > 0)))
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    points = optics.rays(left, pixels) * rest_depth[rows, columns][:, None]
    disparity = sequence["disparity"][:][rows, columns]
    yield Measure(_worst(disparity - _wide(left, right, points)), 1e-3, "rest disparity from depth", "px")
    half = _HALF_PX if sequence["flow"].stored == np.float16 else 0.0
    for t in frames:
        moved = points + sequence["motion"][t][rows, columns]
        flow = cameras.to_pixels(left, moved) - pixels
        off = _worst(sequence["flow"][t][rows, columns] - flow)
        yield Measure(off, 1e-3 + half, f"frame {t}: left flow from motion", "px")
        for ending, view in (("", left), ("_right", right)):
            yield from _eye(sequence, t, ending, view, points, moved, (rows, columns))


def right_of(sequence: Sequence) -> cameras.Camera:
    """The second lens of a stereo sequence at rest.

    Raises:
        KeyError: the sequence has none.
    """
    return optics.camera_of(sequence, sequence.attrs["right"])


def _eye(
    sequence: Sequence,
    t: int,
    ending: str,
    view: cameras.Camera,
    points: Floats,
    moved: Floats,
    at: tuple[NDArray[np.int64], NDArray[np.int64]],
) -> Iterator[Measure]:
    """An eye's depth where the points are seen, and the right eye's flow; medians, for edges lie between."""
    eye = "right" if ending else "left"
    to_eye = np.array([view.translation - optics.camera_of(sequence).translation])
    start, end = cameras.to_pixels(view, points + to_eye), cameras.to_pixels(view, moved + to_eye)
    seen = sequence["visible"][t][at]
    half = _HALF_PX if sequence["flow"].stored == np.float16 else 0.0
    if ending and {"flow_right", "visible_right"} <= set(sequence.fields):
        found = _sampled(sequence["flow_right"][t], start)
        here = _sampled(sequence["visible_right"][t].astype(np.float32), start) > 0.99
        if (here & seen).sum() > 50:
            off = np.abs(found - (end - start))[here & seen].max(axis=1)
            yield Measure(float(np.median(off)), 5e-3 + half, f"frame {t}: right flow from motion", "px")
            most = float(np.quantile(off, 0.95))
            yield Measure(most, 0.1 + half, f"frame {t}: right flow of nearly all", "px")
        seen = seen & here
    name = f"depth{ending}"
    if name in sequence and seen.sum() > 50:
        off = np.abs(_sampled(sequence[name][t], end) - moved[:, 2])[seen] / view.translation[2]
        yield Measure(float(np.median(off)), 2e-5, f"frame {t}: {eye} depth from motion")
        yield Measure(float(np.quantile(off, 0.9)), 5e-4, f"frame {t}: {eye} depth of nearly all")


def _wide(left: cameras.Camera, right: cameras.Camera, points: Floats) -> Floats:
    baseline = left.translation[0] - right.translation[0]
    shift = right.K[0, 2] - left.K[0, 2]
    return np.asarray(left.K[0, 0] * baseline / points[:, 2] - shift)


def _sampled(field: NDArray[np.floating], pixels: Floats) -> NDArray[np.float32]:
    x, y = np.ascontiguousarray(pixels.T, np.float32)
    found = cv2.remap(field.astype(np.float32), x[None], y[None], cv2.INTER_LINEAR, borderValue=0)
    return np.asarray(found[0], np.float32)


def _worst(off: NDArray[np.floating]) -> float:
    return float(np.abs(off).max()) if off.size else 0.0
