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


def rest(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Frame 0 is at rest: no true or recovered motion [px], no force [mN], no load [kPa]."""
    yield Measure(float(np.abs(sequence["flow"][0]).max()), 0.02, "flow in frame 0", "px")
    if "flow_recovered" in sequence:
        most = float(np.abs(sequence["flow_recovered"][0]).max())
        yield Measure(most, 0.02, "recovered flow in frame 0", "px")
    if "force" not in sequence:
        return
    force = np.linalg.norm(sequence["force"][:], axis=1)
    yield Measure(float(force[0]), 1e-6 * max(float(force.max()), 1e-9), "force in frame 0", "mN")
    least, most = (float(np.abs(sequence["traction"][t]).max()) for t in (0, int(np.argmax(force))))
    yield Measure(least, 1e-6 * max(most, 1e-9), "traction in frame 0", "kPa")


def force(sequence: Sequence, frames: list[int]) -> Iterator[Measure | Nothing]:
    """Traction times area, summed over the pixels, equals the force (relative); half of it, if a part of the
    contact is outside the view. The instruments' forces add up to it."""
    area, inside = sequence["area"][:], inner(sequence["tissue"][:], 2)
    if "force" not in sequence:
        yield Nothing("another program's motion without a force")
        return
    applied = sequence["force"][:]
    shown, whole = np.zeros_like(applied), np.ones(len(applied), bool)
    if "force_of" in sequence and applied.any():
        off = np.abs(sequence["force_of"][:].sum(axis=1) - applied).max()
        yield Measure(float(off / np.abs(applied).max()), 1e-6, "sum of the instruments")
    for t in frames:
        traction = sequence["traction"][t]
        size = np.linalg.norm(traction, axis=-1)
        whole[t] = (size[~inside] <= 0.02 * size.max()).all()
        shown[t] = (traction * area[..., None]).sum(axis=(0, 1), dtype=np.float64)
    size = np.maximum(*(np.linalg.norm(one, axis=1) for one in (applied, shown)))
    if not size.max() > 0:
        yield Nothing("no force in any frame")
        return
    for t in frames:
        if size[t] > 0.05 * size.max():
            off = float(np.linalg.norm(shown[t] - applied[t]) / size[t])
            yield Measure(off, 0.01 if whole[t] else 0.5, f"frame {t}")


def compliance(sequence: Sequence, frames: list[int]) -> Iterator[Measure | Nothing]:
    """The compliance changes from frame to frame by no more than the force, plus a quarter.

    Compliance is 2 energy / |force|^2, the load-weighted mean of the displacement along the force, per force.
    With a pulse, the instruments' work on the motion that they cause replaces the energy; the pulse's own
    work is known to a tenth (the tissue's response to it is treated as linear). Motion with inertia or
    relaxation is not checked. Another program's load must do no negative work: a share of the largest.
    """
    mechanics = sequence.attrs.get("mechanics") or {}
    if "work_mn_mm" in mechanics:
        done = np.asarray(mechanics["work_mn_mm"], np.float64)
        yield Measure(-float(done.min() / np.abs(done).max(initial=1e-9)), 0.02, f"frame {done.argmin()}")
        return
    raised, instruments = mechanics.get("pulse_work_mn_mm"), mechanics.get("instruments")
    known = mechanics.get("energy_mn_mm" if raised is None else "tool_work_mn_mm")
    if not (mechanics.get("elastic") or raised is not None) or known is None or not instruments:
        yield Nothing("inertia, relaxation, no instruments, or mechanics without energy")
        return
    if raised is not None and len(instruments) > 1:
        # The instruments' shares of the pulse may cancel, but not their uncertainties.
        yield Nothing("a pulse and several instruments")
        return
    forces = np.stack([one["force_mn"] for one in instruments], axis=1)  # (T, I, 3)
    work = np.asarray(known, np.float64)
    pulse = np.zeros(len(work)) if raised is None else _PULSE_KNOWN * np.abs(raised)
    size = np.linalg.norm(forces, axis=(1, 2))
    for t in range(1, len(work)):
        two = slice(t - 1, t + 1)
        unsure, least = float(max(pulse[two] / np.maximum(work[two], 1e-300))), float(size[two].min())
        if least > 0.05 * size.max() and 0 <= unsure < _COMPLIANCE_STEP:
            before, now = work[two] / size[two] ** 2
            step = float(np.exp(np.abs(np.log(now / before)))) - 1
            changed = float(np.linalg.norm(forces[t] - forces[t - 1])) / least
            yield Measure(step, _COMPLIANCE_STEP + changed + 2 * unsure, f"frame {t}")


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
    first = _contrast(sequence["rgb"][0])
    clear = sequence["tissue"][:] & ~_near(sequence["tool"][0] | sequence["glare"][0])
    for t in frames:
        flow = sequence["flow"][t]
        x, y = _targets(flow)
        blocked = _near(sequence["tool"][t] | sequence["glare"][t])
        free = cv2.remap(blocked.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderValue=1) == 0
        # Smaller motion hardly changes smooth tissue: differences would be highlights and noise only.
        moved = np.hypot(flow[..., 0], flow[..., 1]) > 3.0
        where = clear & sequence["visible"][t] & free & ~blocked & moved
        if where.sum() < 200:
            continue
        now = _contrast(sequence["rgb"][t])
        undone = cv2.remap(now, x, y, cv2.INTER_LINEAR)
        before, after = (float(np.abs(one - first)[where].mean()) for one in (now, undone))
        yield Measure(after / max(before, 1e-9), 1.0, f"frame {t}")


def forward_backward(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """A visible point moved forward by the flow and back returns; no surface is turned over (share)."""
    for t in frames:
        x, y = _targets(sequence["flow"][t])
        visible = sequence["visible"][t] & sequence["tissue"][:]
        if not visible.any():
            continue
        count = int(visible.sum())
        cell = np.stack([y[visible].round(), x[visible].round()], axis=1)
        _, landed, times = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        landed, off = landed.ravel(), np.zeros(len(landed))
        for start in np.nonzero(visible):
            # Back from a pixel of this frame: the mean of all rest pixels that moved to it.
            off += (start - (np.bincount(landed, start) / times)[landed]) ** 2
        yield Measure(float((off > _RETURN_PX**2).sum()) / count, 0.005, f"frame {t}: points don't return")
        corners = visible[:-1, :-1] & visible[1:, :-1] & visible[:-1, 1:]
        turned = (x[:-1, 1:] - x[:-1, :-1]) * (y[1:, :-1] - y[:-1, :-1])
        turned -= (y[:-1, 1:] - y[:-1, :-1]) * (x[1:, :-1] - x[:-1, :-1])
        yield Measure(float((corners & (turned < 0)).sum()) / count, 0.005, f"frame {t}: turned over")


def _targets(flow: Array) -> tuple[Map, Map]:
    """Column and row (H, W) to which each rest pixel has moved."""
    rows, columns = np.indices(flow.shape[:2], np.float32)
    return (columns + flow[..., 0]).astype(np.float32), (rows + flow[..., 1]).astype(np.float32)


def _near(mask: Mask) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)), bool)


def _contrast(rgb: Pixels) -> Map:
    """Brightness normalised by its local mean and contrast, to be independent of lighting."""
    grey = cv2.GaussianBlur(rgb.mean(axis=2, dtype=np.float32), (0, 0), 1.0)
    mean = cv2.GaussianBlur(grey, (0, 0), 8.0)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((grey - mean) ** 2, (0, 0), 8.0), 1.0))
    return np.asarray((grey - mean) / spread, np.float32)
