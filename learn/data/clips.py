"""Sequences as the network meets them: displacement and force density on the grid, read from stores."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from learn.data.grid import Grid, Resampler, centre, settled
from synth.dataset.split import name_anatomy
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError

Input = Literal["ideal", "recovered", "noisy", "mixed"]
INPUTS = ("ideal", "recovered", "noisy", "mixed")
Target = Literal["density", "intensity"]
FIELDS = {"ideal": "flow", "recovered": "flow_recovered", "noisy": "flow_noisy"}
"""Field of a store that holds each displacement. `noisy` is the published regime: true flow with its
noise."""
_CURE = {
    "ideal": "render it anew",
    "recovered": "render with flow.backend other than 'ideal'",
    "noisy": "render with store.extra: [flow_noisy]",
}
_VERSION = 3
_ARRAYS = ("mask", "confidence", "density", "force")
_PLAIN = ("name", "content_hash", "group", "family", "gesture", "young_kpa")


@dataclass(frozen=True)
class Clip:
    """One sequence on the grid."""

    name: str
    content_hash: str
    group: str
    """Sequences of equal group may never be on both sides of a split."""
    family: str
    gesture: str
    young_kpa: float
    mask: NDArray[np.float32]
    """(N, N) 0/1, tissue."""
    displacement: dict[str, NDArray[np.float32]]
    """`ideal`, `recovered` and/or `noisy`: (T, 2, N, N) mm in picture axes."""
    confidence: NDArray[np.float32]
    """(T, N, N) 0..1 of the recovered flow; 1 where there is none."""
    density: NDArray[np.float32]
    """(T, 3, N, N) force density per unit stiffness, camera axes [mN/mm² at E = 1 kPa]. Its sum times the
    cell's area times E is the force on the tissue in view: what falls into cells that are mostly not tissue
    is carried by the nearest cell that is; only what lies off the grid is in `force` alone."""
    force: NDArray[np.float64]
    """(T, 3) total force on the tissue, camera axes [mN]."""

    @property
    def frames(self) -> int:
        return len(self.density)


def sources(wanted: Input) -> tuple[str, ...]:
    """Which displacements an input kind needs."""
    if wanted not in INPUTS:
        raise UserError(f"unknown input {wanted!r}: one of {', '.join(INPUTS)}")
    return ("ideal", "recovered") if wanted == "mixed" else (wanted,)


def read_clip(sequence: Sequence, grid: Grid, wanted: Iterable[str]) -> Clip:
    """One store on the grid.

    `wanted`: any of `ideal`, `recovered`, `noisy`. Raises UserError if the store lacks the flow or has no
    tissue.
    """
    attrs = sequence.attrs
    where = sequence.path.name
    wanted = tuple(wanted)
    for source in wanted:
        if FIELDS[source] not in sequence:
            raise UserError(
                f"{where}: holds no {source} flow (field {FIELDS[source]}); {_CURE[source]}, "
                "or use --input ideal"
            )
    scenario: dict[str, Any] = attrs.get("scenario") or {}
    try:
        young, scale = float(attrs["young_kpa"]), float(attrs["scale_mm_per_px"])
    except KeyError as missing:
        raise UserError(f"{where}: lacks the attribute {missing.args[0]}") from None
    tissue = sequence["tissue"][:].astype(bool)
    resample = Resampler((tissue.shape[0], tissue.shape[1]), scale, centre(tissue), grid)
    mask = (resample.cover(tissue) > 0.5).astype(np.float32)
    area = sequence["area"][:]
    n, frames = grid.size, sequence.frames
    displacement = {s: np.empty((frames, 2, n, n), np.float32) for s in wanted}
    confidence = np.ones((frames, n, n), np.float32)
    density = np.empty((frames, 3, n, n), np.float32)
    surest = "recovered" in wanted and "flow_confidence" in sequence
    for t in range(frames):
        for source in wanted:
            moved = sequence[FIELDS[source]][t].transpose(2, 0, 1) * scale
            displacement[source][t] = resample.mean(moved, tissue) * mask
        if surest:
            confidence[t] = resample.mean(sequence["flow_confidence"][t], tissue) * mask
        load_clips = sequence["traction"][t].transpose(2, 0, 1) * area
        density[t] = settled(resample.sum(load_clips), mask) / np.float32(grid.pitch_mm**2 * young)
    return Clip(
        name=where,
        content_hash=str(attrs["content_hash"]),
        group=name_anatomy(attrs),
        family=str(scenario.get("family", "")),
        gesture=str((scenario.get("gesture") or {}).get("kind", "")),
        young_kpa=young,
        mask=mask,
        displacement=displacement,
        confidence=confidence,
        density=density,
        force=sequence["force"][:],
    )


def load_clips(
    root: Path,
    grid: Grid,
    wanted: Iterable[str],
    *,
    cache: Path | None = None,
    report: Callable[[int, int], None] = lambda done, of: None,
) -> list[Clip]:
    """All sealed sequences of a dataset, in order.

    `cache`: folder of packed arrays, made on first use and memory-mapped after; keyed by content hash and
    grid, so it can be shared and can't be stale. Raises UserError for an empty dataset.
    """
    wanted = tuple(wanted)
    dataset = Dataset(root)
    clips = []
    for i, sequence in enumerate(dataset):
        report(i, len(dataset))
        clips.append(
            read_clip(sequence, grid, wanted) if cache is None else _packed(sequence, grid, wanted, cache)
        )
    report(len(dataset), len(dataset))
    return clips


def _packed(sequence: Sequence, grid: Grid, wanted: tuple[str, ...], cache: Path) -> Clip:
    key = f"{sequence.attrs['content_hash']}-{grid.size}-{grid.extent_mm:g}-{'+'.join(wanted)}-v{_VERSION}"
    if not (cache / key).is_dir():
        pack(read_clip(sequence, grid, wanted), cache / key)
    return unpack(cache / key)


def pack(clip: Clip, folder: Path) -> None:
    """Writes a clip as plain arrays, beside and renamed; a folder that is there already stays."""
    part = folder.with_name(f"{folder.name}.part{os.getpid()}")
    part.mkdir(parents=True, exist_ok=True)
    for name in _ARRAYS:
        np.save(part / f"{name}.npy", getattr(clip, name))
    for source, values in clip.displacement.items():
        np.save(part / f"displacement-{source}.npy", values)
    plain = {name: getattr(clip, name) for name in _PLAIN}
    (part / "clip.json").write_text(json.dumps(plain | {"sources": list(clip.displacement)}))
    if folder.is_dir():
        shutil.rmtree(part)
    else:
        part.rename(folder)


def unpack(folder: Path) -> Clip:
    """A packed clip, memory-mapped. Raises UserError if the folder is not one."""

    def mapped(name: str) -> NDArray[Any]:
        array: NDArray[Any] = np.load(folder / f"{name}.npy", mmap_mode="r")
        return array

    try:
        plain = json.loads((folder / "clip.json").read_text())
        displacement = {source: mapped(f"displacement-{source}") for source in plain.pop("sources")}
        arrays: dict[str, Any] = {name: mapped(name) for name in _ARRAYS}
        return Clip(**plain, displacement=displacement, **arrays)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{folder}: damaged packed sequence ({error}); remove it") from None


def target(clip: Clip, frame: int, kind: Target, components: int) -> NDArray[np.float32]:
    """(C, N, N) what the network should say about a frame [mN/mm² or, for intensity, mN; at E = 1 kPa].

    `density` is the truth; one component gives its length. `intensity` is the paper's map: the density's
    shape with its peak raised to the total force. It does not integrate to anything.
    """
    density = clip.density[frame]
    if kind == "density" and components == 3:
        return np.asarray(density)
    length: NDArray[np.float32] = np.sqrt(np.square(density).sum(0, keepdims=True))
    if kind == "intensity":
        if components != 1:
            raise UserError("the paper's intensity map has no direction: use output 'magnitude' with it")
        peak = float(length.max())
        total = float(np.linalg.norm(clip.force[frame])) / clip.young_kpa
        length = length * np.float32(total / peak) if peak > 0 else length
    return length


def amount(clip: Clip, kind: Target, components: int, pitch_mm: float) -> NDArray[np.float64]:
    """(T, C) total force that a map of this kind can be held to [mN at E = 1 kPa].

    A vector map adds up to the force on the tissue, and an intensity map peaks at its size. A map of lengths
    knows no direction: two jaws that pull against each other add up in it, so it is held to the sum of
    lengths
    (C = 1), which is the force's size where all of it points one way.
    """
    if components == 3:
        return clip.force / clip.young_kpa
    if kind == "intensity":
        size: NDArray[np.float64] = np.linalg.norm(clip.force, axis=1, keepdims=True) / clip.young_kpa
        return size
    length = np.sqrt(np.square(np.asarray(clip.density), dtype=np.float64).sum(1))
    total: NDArray[np.float64] = length.sum((1, 2))[:, None] * pitch_mm**2
    return total


def typical_young(clips: Iterable[Clip]) -> float:
    """Geometric mean of E over sequences [kPa]: the best guess when a recording's E is unknown."""
    return float(np.exp(np.mean([np.log(c.young_kpa) for c in clips])))
