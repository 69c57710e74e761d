"""Consistency of motion, load and picture in every sequence, each with its limit."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from synth.arrays import Array, Map, Mask, Pixels
from synth.checks.measurements import Measure, Nothing, inner
from synth.dataset.store import Sequence

# Error of a point moved forward and back: compressed or slanted tissue is projected to few pixels.
_RETURN_PX = 4.0
_COMPLIANCE_STEP = 0.25  # relative change from frame to frame
_PULSE_KNOWN = 0.1  # relative uncertainty of the pulse's work
LEAST_MOVING_PX = 400  # that move by over 3 px, by which `warp` judges


def rest(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Frame 0 is at rest: no true or recovered motion [px], no force [mN], no load [kPa]."""
    yield Measure(float(np.abs(sequence["flow"][0]).max()), 0.02, "flow in frame 0", "px")
    if "flow_recovered" in sequence:
        largest = float(np.abs(sequence["flow_recovered"][0]).max())
        yield Measure(largest, 0.02, "recovered flow in frame 0", "px")
    if "force" not in sequence:
        return
    force = np.linalg.norm(sequence["force"][:], axis=1)
    yield Measure(float(force[0]), 1e-6 * max(float(force.max()), 1e-9), "force in frame 0", "mN")
    smallest, largest = (float(np.abs(sequence["traction"][t]).max()) for t in (0, int(np.argmax(force))))
    yield Measure(smallest, 1e-6 * max(largest, 1e-9), "traction in frame 0", "kPa")


def force(sequence: Sequence, frames: list[int]) -> Iterator[Measure | Nothing]:
    """Traction times area, summed over the pixels, equals the force (relative); half of it, if a part of the
    contact is outside the view. The instruments' forces add up to it."""
    area, inside = sequence["area"][:], inner(sequence["tissue"][:], 2)
    if "force" not in sequence:
        yield Nothing("another program's motion without a force")
        return
    total_force = sequence["force"][:]
    pixel_force, in_view = np.zeros_like(total_force), np.ones(len(total_force), bool)
    if "force_of" in sequence and total_force.any():
        error = np.abs(sequence["force_of"][:].sum(axis=1) - total_force).max()
        yield Measure(float(error / np.abs(total_force).max()), 1e-6, "sum of the instruments")
    for t in frames:
        traction = sequence["traction"][t]
        size = np.linalg.norm(traction, axis=-1)
        in_view[t] = (size[~inside] <= 0.02 * size.max()).all()
        pixel_force[t] = (traction * area[..., None]).sum(axis=(0, 1), dtype=np.float64)
    size = np.maximum(*(np.linalg.norm(vectors, axis=1) for vectors in (total_force, pixel_force)))
    if not size.max() > 0:
        yield Nothing("no force in any frame")
        return
    for t in frames:
        if size[t] > 0.05 * size.max():
            error = float(np.linalg.norm(pixel_force[t] - total_force[t]) / size[t])
            yield Measure(error, 0.01 if in_view[t] else 0.5, f"frame {t}")


def compliance(sequence: Sequence, frames: list[int]) -> Iterator[Measure | Nothing]:
    """The compliance changes from frame to frame by no more than the force, plus a quarter.

    Compliance is 2 energy / |force|^2, the load-weighted mean of the displacement along the force, per force.
    With a pulse, the instruments' work on the motion that they cause replaces the energy; the pulse's own
    work is known to a tenth (the tissue's response to it is treated as linear). Motion with inertia or
    relaxation is not checked. Another program's load must do no negative work: a share of the largest.
    """
    mechanics = sequence.attrs.get("mechanics") or {}
    if "work_mn_mm" in mechanics:
        load_work = np.asarray(mechanics["work_mn_mm"], np.float64)
        yield Measure(
            -float(load_work.min() / np.abs(load_work).max(initial=1e-9)), 0.02, f"frame {load_work.argmin()}"
        )
        return
    pulse_work, instruments = mechanics.get("pulse_work_mn_mm"), mechanics.get("instruments")
    energy = mechanics.get("energy_mn_mm" if pulse_work is None else "tool_work_mn_mm")
    if not (mechanics.get("elastic") or pulse_work is not None) or energy is None or not instruments:
        yield Nothing("inertia, relaxation, no instruments, or mechanics without energy")
        return
    if pulse_work is not None and len(instruments) > 1:
        # The instruments' shares of the pulse may cancel, but not their uncertainties.
        yield Nothing("a pulse and several instruments")
        return
    forces = np.stack([instrument["force_mn"] for instrument in instruments], axis=1)  # (T, I, 3)
    work = np.asarray(energy, np.float64)
    pulse = np.zeros(len(work)) if pulse_work is None else _PULSE_KNOWN * np.abs(pulse_work)
    size = np.linalg.norm(forces, axis=(1, 2))
    for t in range(1, len(work)):
        pair = slice(t - 1, t + 1)
        uncertainty = float(max(pulse[pair] / np.maximum(work[pair], 1e-300)))
        least_force = float(size[pair].min())
        if least_force > 0.05 * size.max() and 0 <= uncertainty < _COMPLIANCE_STEP:
            before, now = work[pair] / size[pair] ** 2
            step = float(np.exp(np.abs(np.log(now / before)))) - 1
            force_change = float(np.linalg.norm(forces[t] - forces[t - 1])) / least_force
            yield Measure(step, _COMPLIANCE_STEP + force_change + 2 * uncertainty, f"frame {t}")


def visibility(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """No visible point has left the picture or is behind the instrument (share of pixels)."""
    height, width = sequence.size
    for t in frames:
        x, y = _targets(sequence["flow"][t])
        visible = sequence["visible"][t] & sequence["tissue"][:]
        if not visible.any():
            continue
        outside = (x < -0.6) | (y < -0.6) | (x > width - 0.4) | (y > height - 0.4)
        # A point near the instrument's outline may fall on either side of it.
        core = cv2.erode(sequence["tool"][t].astype(np.uint8), np.ones((5, 5), np.uint8))
        covered = cv2.remap(core, x, y, cv2.INTER_NEAREST, borderValue=0).astype(bool)
        count = int(visible.sum())
        yield Measure(float((visible & outside).sum()) / count, 0.0, f"frame {t}: outside the picture")
        yield Measure(float((visible & covered).sum()) / count, 0.002, f"frame {t}: behind the instrument")


def warp(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """A frame warped back by the true flow resembles the rest frame: remaining difference (relative)."""
    rest_contrast = _contrast(sequence["rgb"][0])
    clear = sequence["tissue"][:] & ~_dilate(sequence["tool"][0] | sequence["glare"][0])
    for t in frames:
        flow = sequence["flow"][t]
        x, y = _targets(flow)
        blocked = _dilate(sequence["tool"][t] | sequence["glare"][t])
        unblocked = cv2.remap(blocked.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderValue=1) == 0
        # Smaller motion hardly changes smooth tissue: differences would be highlights and noise only.
        moving = np.hypot(flow[..., 0], flow[..., 1]) > 3.0
        pixels = clear & sequence["visible"][t] & unblocked & ~blocked & moving
        # Fewer are a ring about the instrument, in which its shadow and the dent's shading differ most.
        if pixels.sum() < LEAST_MOVING_PX:
            continue
        contrast = _contrast(sequence["rgb"][t])
        unwarped = cv2.remap(contrast, x, y, cv2.INTER_LINEAR)
        rest_error, warped_error = (
            float(np.abs(picture - rest_contrast)[pixels].mean()) for picture in (contrast, unwarped)
        )
        yield Measure(warped_error / max(rest_error, 1e-9), 1.0, f"frame {t}")


def forward_backward(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """A visible point moved forward by the flow and back returns; no surface is turned over (share)."""
    for t in frames:
        x, y = _targets(sequence["flow"][t])
        visible = sequence["visible"][t] & sequence["tissue"][:]
        if not visible.any():
            continue
        count = int(visible.sum())
        cell = np.stack([y[visible].round(), x[visible].round()], axis=1)
        _, targets, counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        targets, squared_error = targets.ravel(), np.zeros(len(targets))
        for start in np.nonzero(visible):
            # Back from a pixel of this frame: the mean of all rest pixels that moved to it.
            squared_error += (start - (np.bincount(targets, start) / counts)[targets]) ** 2
        yield Measure(
            float((squared_error > _RETURN_PX**2).sum()) / count, 0.005, f"frame {t}: points don't return"
        )
        corners = visible[:-1, :-1] & visible[1:, :-1] & visible[:-1, 1:]
        orientation = (x[:-1, 1:] - x[:-1, :-1]) * (y[1:, :-1] - y[:-1, :-1])
        orientation -= (y[:-1, 1:] - y[:-1, :-1]) * (x[1:, :-1] - x[:-1, :-1])
        yield Measure(float((corners & (orientation < 0)).sum()) / count, 0.005, f"frame {t}: turned over")


def _targets(flow: Array) -> tuple[Map, Map]:
    """Column and row (H, W) to which each rest pixel has moved."""
    rows, columns = np.indices(flow.shape[:2], np.float32)
    return (columns + flow[..., 0]).astype(np.float32), (rows + flow[..., 1]).astype(np.float32)


def _dilate(mask: Mask) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)), bool)


def _contrast(rgb: Pixels) -> Map:
    """Brightness normalised by its local mean and contrast, to be independent of lighting."""
    grey = cv2.GaussianBlur(rgb.mean(axis=2, dtype=np.float32), (0, 0), 1.0)
    mean = cv2.GaussianBlur(grey, (0, 0), 8.0)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((grey - mean) ** 2, (0, 0), 8.0), 1.0))
    return np.asarray((grey - mean) / spread, np.float32)
