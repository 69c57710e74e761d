"""Consistency of both cameras of a stereo sequence: flows, depths and motion are stored separately."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Map, Mask
from synth.checks import optics
from synth.checks.measurements import Measure, Nothing, inner
from synth.dataset.store import Sequence
from synth.render.camera import camera as cameras

_EVERY = 9  # every 9th rest pixel is checked
_FEWEST = 50  # least number of points for a median
_HALF_PX = 0.008  # rounding of a flow below 32 px in float16


def stereo(sequence: Sequence, frames: list[int]) -> Iterator[Measure | Nothing]:
    """Flows and depths of both cameras, rest disparity and motion in space agree [px, relative]."""
    if not {"motion", "disparity", "depth"} <= set(sequence.fields):
        yield Nothing("no depth is stored" if "motion" in sequence else "one camera")
        return
    left, right = optics.camera_of(sequence), right_of(sequence)
    rest_depth = sequence["depth"][0].astype(np.float64)
    core = inner(sequence["tissue"][:] & ~sequence["tool"][0], 2)
    rows, columns = (indices[::_EVERY] for indices in np.nonzero(core & (rest_depth > 0)))
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    if not len(pixels):
        yield Nothing("no tissue in view")
        return
    points = cameras.rays(left, pixels) * rest_depth[rows, columns][:, None]
    expected, (turn, shift) = cameras.disparity(left, right, points), cameras.between(left, right)
    disparity = sequence["disparity"][:][rows, columns]
    yield Measure(float(np.abs(disparity - expected).max(initial=0)), 1e-3, "rest disparity from depth", "px")
    rounding_px = _HALF_PX if sequence["flow"].stored == np.float16 else 0.0
    for t in frames:
        moved_points = points + sequence["motion"][t][rows, columns]
        flow = cameras.to_pixels(left, moved_points) - pixels
        error_px = float(np.abs(sequence["flow"][t][rows, columns] - flow).max(initial=0))
        yield Measure(error_px, 1e-3 + rounding_px, f"frame {t}: left flow from motion", "px")
        # Medians, as interpolation is wrong at edges.
        visible = sequence["visible"][t][rows, columns]
        yield from _depth(sequence, t, "depth", cameras.to_pixels(left, moved_points), moved_points, visible)
        right_points = moved_points @ turn.T + shift
        start, end = (
            cameras.to_pixels(right, positions) for positions in (points @ turn.T + shift, right_points)
        )
        if {"flow_right", "visible_right"} <= set(sequence.fields):
            visible &= _sample_field(sequence["visible_right"][t].astype(np.float32), start) > 0.99
            if visible.sum() > _FEWEST:
                errors_px = np.abs(_sample_field(sequence["flow_right"][t], start) - (end - start))[visible]
                median, upper = np.quantile(errors_px.max(axis=1), (0.5, 0.95)).tolist()
                yield Measure(median, 5e-3 + rounding_px, f"frame {t}: right flow from motion", "px")
                yield Measure(upper, 0.1 + rounding_px, f"frame {t}: right flow of 95%", "px")
        yield from _depth(sequence, t, "depth_right", end, right_points, visible)


def right_of(sequence: Sequence) -> cameras.Camera:
    """The right camera of a stereo sequence at rest. KeyError if there is none."""
    return optics.camera_of(sequence, sequence.attrs["right"])


def _depth(
    sequence: Sequence, t: int, name: str, pixels: Floats, points: Floats, visible: Mask
) -> Iterator[Measure]:
    """A camera's depth at pixels (N, 2), against that of the points (N, 3) mm visible there."""
    if name in sequence and visible.sum() > _FEWEST:
        errors = np.abs(_sample_field(sequence[name][t], pixels) - points[:, 2])[visible]
        median, upper = (np.quantile(errors, (0.5, 0.9)) / float(sequence.attrs["translation"][2])).tolist()
        yield Measure(median, 2e-5, f"frame {t}: {name} from motion")
        yield Measure(upper, 5e-4, f"frame {t}: {name} of 90%")


def _sample_field(field: NDArray[np.floating], pixels: Floats) -> Map:
    x, y = np.ascontiguousarray(pixels.T, np.float32)
    samples = cv2.remap(field.astype(np.float32), x[None], y[None], cv2.INTER_LINEAR, borderValue=0)
    return np.asarray(samples[0], np.float32)
