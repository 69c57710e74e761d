"""What must hold in every sequence: named measures, each with the limit it must keep."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.checks import optics, stereo
from synth.checks.measure import Invariant, Measure, truth
from synth.dataset.store import Sequence
from synth.fields import FIELDS

Floats = NDArray[np.floating]

# A point may come back so far off: tissue that is pressed together or seen at a slant lands in few pixels.
_RETURN_PX = 4.0
_COMPLIANCE_STEP = 0.25
_PULSE_KNOWN = 0.1


def seal(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """The attributes are those that were sealed, under the name that was given."""
    yield truth(sequence.is_sealed(), "attributes were edited")
    yield truth(sequence.path.stem == f"{sequence.index:06d}", "is another sequence than its name says")


def schema(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """The fields are those that the table declares: shape, type, unit, meaning, axes."""
    for field in FIELDS.values():
        if field.name in sequence:
            column = sequence[field.name]
            known = {"unit": field.unit, "meaning": field.meaning}
            yield truth(column.attrs == known, f"{field.name}: unit or meaning was edited")
            yield truth(column.dims == field.dims, f"{field.name}: axes were edited")
        else:
            yield truth(field.kept != "always", f"{field.name} is missing")


def rest(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Frame 0 is at rest: no true or recovered motion [px], no force [mN], no load [kPa]."""
    yield Measure(float(np.abs(sequence["flow"][0]).max()), 0.02, "flow in frame 0", "px")
    if "flow_recovered" in sequence:
        most = float(np.abs(sequence["flow_recovered"][0]).max())
        yield Measure(most, 0.02, "recovered flow in frame 0", "px")
    force = np.linalg.norm(sequence["force"][:], axis=1)
    yield Measure(float(force[0]), 1e-6 * max(float(force.max()), 1e-9), "force in frame 0", "mN")
    most = float(np.abs(sequence["traction"][int(np.argmax(force))]).max())
    least = float(np.abs(sequence["traction"][0]).max())
    yield Measure(least, 1e-6 * max(most, 1e-9), "traction in frame 0", "kPa")


def force(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Traction times area, summed over the pixels, is the force (relative), where the contact is in view."""
    area, tissue = sequence["area"][:], sequence["tissue"][:]
    inside = cv2.erode(tissue.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0).astype(bool)
    applied = sequence["force"][:]
    peak = np.linalg.norm(applied, axis=1).max()
    for t in frames:
        traction = sequence["traction"][t]
        size = np.linalg.norm(traction, axis=-1)
        in_view = bool((size[~inside] <= 0.02 * size.max()).all())
        norm = float(np.linalg.norm(applied[t]))
        if in_view and norm > 0.05 * peak:
            total = (traction * area[..., None]).sum(axis=(0, 1), dtype=np.float64)
            yield Measure(float(np.linalg.norm(total - applied[t])) / norm, 0.01, f"frame {t}")


def compliance(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Displacement per force changes from frame to frame no faster than the force does, plus a quarter.

    2 energy / |force|^2 is the loaded mean of the displacement along the force, per force. With a pulse, the
    tools' work on the motion that is theirs stands for the energy. Motion with inertia or relaxation is left
    out: there the past counts too.
    """
    mechanics = sequence.attrs.get("mechanics") or {}
    raised = mechanics.get("pulse_work_mn_mm")
    # Sequences from before `elastic` was kept: among the named jobs only `paper` has inertia, and this law.
    elastic = mechanics.get("elastic", mechanics.get("law") != "corotational")
    known = "tool_work_mn_mm" if raised is not None else "energy_mn_mm"
    if not (elastic or raised is not None) or known not in mechanics:
        return
    instruments = mechanics["instruments"]
    if raised is not None and len(instruments) > 1:
        return  # their shares of the pulse may cancel, what is not known of them does not
    forces = np.stack([one["force_mn"] for one in instruments], axis=1)
    tips, footprint = None, 1.0
    if mechanics.get("contact") == "rigid":
        tips = np.concatenate([one["tip_mm"] for one in instruments], axis=1)
        footprint = float(sequence.attrs["scenario"]["gesture"]["footprint_mm"])
    work = np.asarray(mechanics[known], np.float64)
    pulse = None if raised is None else np.asarray(raised, np.float64)
    for t, step, limit in compliance_steps(work, forces, tips, footprint, pulse):
        yield Measure(step, limit, f"frame {t}")


def compliance_steps(
    work: Floats,
    forces: Floats,
    tips: Floats | None,
    footprint_mm: float,
    pulse: Floats | None = None,
) -> Iterator[tuple[int, float, float]]:
    """Steps of displacement per force: frame, relative step and its limit.

    Args:
        work: (T,) mN mm, half of force times displacement.
        forces: (T, I, 3) mN.
        tips: (T, n, 3) mm of rigid ones, which touch another relief as they slide; None: tractions.
        footprint_mm: their radius: along it, displacement per force may change by once itself.
        pulse: (T,) mN mm, of the pulse's own displacement, which is not in `work`. It is known to a tenth
            only (of a neo-Hookean law, whose answer to the pulse is taken as linear).
    """
    beat = np.zeros(len(work)) if pulse is None else _PULSE_KNOWN * np.abs(pulse)
    size = np.linalg.norm(forces, axis=(1, 2))
    for t in range(1, len(work)):
        unsure = max(beat[t - 1 : t + 1] / np.maximum(work[t - 1 : t + 1], 1e-300))
        if min(size[t - 1], size[t]) > 0.05 * size.max() and 0 <= unsure < _COMPLIANCE_STEP:
            here, before = work[t] / size[t] ** 2, work[t - 1] / size[t - 1] ** 2
            changed = float(np.linalg.norm(forces[t] - forces[t - 1])) / float(min(size[t - 1], size[t]))
            step = float(np.exp(np.abs(np.log(here / before)))) - 1
            slid = 0.0
            if tips is not None:
                slid = float(np.linalg.norm((tips[t] - tips[t - 1])[:, :2], axis=1).max()) / footprint_mm
            yield t, step, _COMPLIANCE_STEP + changed + slid + 2 * float(unsure)


def visibility(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """No point counts as visible that has left the picture or is behind the instrument (share of pixels)."""
    tissue = sequence["tissue"][:]
    height, width = tissue.shape
    for t in frames:
        x, y = _targets(sequence["flow"][t])
        seen = sequence["visible"][t] & tissue
        outside = (x < -0.6) | (y < -0.6) | (x > width - 0.4) | (y > height - 0.4)
        # A point near the instrument's outline may fall on either side of it.
        core = cv2.erode(sequence["tool"][t].astype(np.uint8), np.ones((5, 5), np.uint8))
        covered = cv2.remap(core, x, y, cv2.INTER_NEAREST, borderValue=0).astype(bool)
        count = max(int(seen.sum()), 1)
        yield Measure(float((seen & outside).sum()) / count, 0.0, f"frame {t}: outside the picture")
        yield Measure(float((seen & covered).sum()) / count, 0.002, f"frame {t}: behind the instrument")


def warp(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Undoing the true motion makes a frame look like the rest frame: difference left (relative)."""
    tissue = sequence["tissue"][:]
    first = _contrast(sequence["rgb"][0])
    calm = tissue & ~_near(sequence["tool"][0] | sequence["glare"][0])
    for t in frames:
        flow = sequence["flow"][t]
        x, y = _targets(flow)
        blocked = _near(sequence["tool"][t] | sequence["glare"][t])
        free = cv2.remap(blocked.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderValue=1) == 0
        # Less motion hardly changes smooth tissue: what sparkles and noise are all that is left.
        moved = np.hypot(flow[..., 0], flow[..., 1]) > 3.0
        where = calm & sequence["visible"][t] & free & ~blocked & moved
        if where.sum() < 200:
            continue
        now = _contrast(sequence["rgb"][t])
        undone = cv2.remap(now, x, y, cv2.INTER_LINEAR)
        before = float(np.abs(now - first)[where].mean())
        after = float(np.abs(undone - first)[where].mean())
        yield Measure(after / max(before, 1e-9), 1.0, f"frame {t}")


def forward_backward(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Forward by the flow and back, a visible point is where it was; none is seen from behind (share)."""
    tissue = sequence["tissue"][:]
    for t in frames:
        x, y = _targets(sequence["flow"][t])
        seen = sequence["visible"][t] & tissue
        count = max(int(seen.sum()), 1)
        rows, columns = np.nonzero(seen)
        cell = np.stack([y[seen].round(), x[seen].round()], axis=1)
        _, landed, times = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        lost = np.zeros(len(rows))
        for rest in (rows, columns):
            # Back from a pixel of this frame: the mean of all rest pixels that came to it.
            back = np.bincount(landed.ravel(), rest) / times
            lost += (rest - back[landed.ravel()]) ** 2
        yield Measure(float((lost > _RETURN_PX**2).sum()) / count, 0.005, f"frame {t}: not where it was")
        whole = seen[:-1, :-1] & seen[1:, :-1] & seen[:-1, 1:]
        turned = (x[:-1, 1:] - x[:-1, :-1]) * (y[1:, :-1] - y[:-1, :-1])
        turned -= (y[:-1, 1:] - y[:-1, :-1]) * (x[1:, :-1] - x[:-1, :-1])
        yield Measure(float((whole & (turned < 0)).sum()) / count, 0.005, f"frame {t}: seen from behind")


INVARIANTS: dict[str, Invariant] = {
    function.__name__: function
    for function in (
        seal,
        schema,
        rest,
        force,
        compliance,
        visibility,
        warp,
        forward_backward,
        optics.camera,
        optics.contact,
        stereo.stereo,
    )
}
"""Every invariant by name, in the order in which they are checked."""


def _targets(flow: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rows, columns = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    return (columns + flow[..., 0]).astype(np.float32), (rows + flow[..., 1]).astype(np.float32)


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)), bool)


def _contrast(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Brightness without its local mean and scale, so that light and shadow do not count."""
    grey = cv2.GaussianBlur(rgb.mean(axis=2, dtype=np.float32), (0, 0), 1.0)
    mean = cv2.GaussianBlur(grey, (0, 0), 8.0)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((grey - mean) ** 2, (0, 0), 8.0), 1.0))
    return np.asarray((grey - mean) / spread, np.float32)
