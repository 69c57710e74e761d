"""What must hold in every sequence: named measures, each with the limit it must keep."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from synth import store
from synth.fields import FIELDS
from synth.store import Sequence

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Measure:
    """One number that must not exceed its limit, and where it was found."""

    value: float
    limit: float
    where: str

    @property
    def good(self) -> bool:
        return bool(self.value <= self.limit)

    @property
    def severity(self) -> float:
        """Above 1 is bad; compares measures whose limits differ."""
        if self.limit > 0:
            return self.value / self.limit
        return 0.0 if self.good else np.inf


Invariant = Callable[[Sequence, list[int]], Iterator[Measure]]
"""Measures of a sequence in the frames given."""


def seal(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """The attributes are those that were sealed, and the fields are those that the table declares."""
    attrs = sequence.attrs
    yield _truth(attrs.get("seal_hash") == store.seal_hash(attrs), "attributes were edited")
    yield _truth(attrs["content_hash"] == store.content_hash(attrs), "attributes were edited")
    yield _truth(sequence.path.stem == f"{sequence.index:06d}", "is another sequence than its name says")
    for field in FIELDS.values():
        if field.name in sequence:
            column = sequence[field.name]
            known = {"unit": field.unit, "meaning": field.meaning}
            yield _truth(column.attrs == known, f"{field.name}: unit or meaning was edited")
            yield _truth(column.dims == field.dims, f"{field.name}: axes were edited")
        else:
            yield _truth(field.optional, f"{field.name} is missing")


def checksum(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Every value is the one that was written; NaN and values out of their range are found on the way."""
    for name in sequence.fields:
        field, column = FIELDS[name], sequence[name]
        hasher = store.field_hasher(field, column.stored, column.shape)
        parts = range(column.shape[0]) if field.framed else [...]
        low, high, finite = np.inf, -np.inf, True
        for part in parts:
            values = np.ascontiguousarray(column[part])
            hasher.update(values.astype(column.stored, copy=False).data)
            if values.dtype.kind == "f":
                low, high = min(low, float(values.min())), max(high, float(values.max()))
                finite = finite and bool(np.isfinite(values).all())
        good = hasher.hexdigest() == sequence.attrs["field_hashes"][name]
        yield _truth(good, f"{name}: values are not those that were written")
        yield _truth(finite, f"{name}: holds values that are no numbers")
        if field.low is not None:
            yield Measure(field.low - low, 0.0, f"{name}: smallest value {low:g} {field.unit}")
        if field.high is not None:
            yield Measure(high - field.high, 0.0, f"{name}: largest value {high:g} {field.unit}")


def rest(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """Frame 0 is at rest: no motion [px] and no force [mN]."""
    yield Measure(float(np.abs(sequence["flow"][0]).max()), 0.02, "flow in frame 0")
    force = np.linalg.norm(sequence["force"][:], axis=1)
    yield Measure(float(force[0]), 1e-6 * max(float(force.max()), 1e-9), "force in frame 0")


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
        moved = np.hypot(flow[..., 0], flow[..., 1]) > 1.5
        where = calm & sequence["visible"][t] & free & ~blocked & moved
        if where.sum() < 200:
            continue
        now = _contrast(sequence["rgb"][t])
        undone = cv2.remap(now, x, y, cv2.INTER_LINEAR)
        before = float(np.abs(now - first)[where].mean())
        after = float(np.abs(undone - first)[where].mean())
        yield Measure(after / max(before, 1e-9), 1.0, f"frame {t}")


def camera(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """No pixel sees less tissue than one that looks at it squarely: K and depth against area (relative)."""
    focal = float(sequence.attrs["K"][0][0]) * float(sequence.attrs["K"][1][1])
    tissue, depth, area = sequence["tissue"][:], sequence["depth"][0], sequence["area"][:]
    where = tissue & ~sequence["tool"][0] & (area > 0)
    yield _truth(bool(where.any()), "no tissue in view")
    if where.any():
        square = depth[where].astype(np.float64) ** 2 / focal
        # Distortion stretches pixels by some percent towards the corners.
        short = float(np.quantile(1 - area[where] / square, 0.99))
        yield Measure(short, 0.15, "1st percentile of area")
        yield Measure(float(np.median(area[where] / square)), 4.0, "median of area")


INVARIANTS: dict[str, Invariant] = {
    function.__name__: function for function in (seal, checksum, rest, force, visibility, warp, camera)
}
"""Every invariant by name, in the order in which they are checked."""


def _truth(good: bool, where: str) -> Measure:
    return Measure(0.0 if good else 1.0, 0.0, where)


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
