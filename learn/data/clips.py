"""Sequences on the network's grid: displacement and force density, read from stores."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

from learn.data.grid import Grid, GridView, certainty, settle
from synth.arrays import Array, Floats, Map
from synth.dataset.sequence_split import name_anatomy
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError, as_user_error
from synth.formats import CLIPS
from synth.job import identity
from synth.job.types import MembraneState
from synth.system import checked_file
from synth.system.terminal import ProgressCallback

Input = Literal["ideal", "recovered", "noisy", "mixed", "motion", "motion-ideal", "motion-mixed"]
FIELDS = {
    "ideal": "flow",
    "recovered": "flow_recovered",
    "noisy": "flow_noisy",
    "motion": "motion_recovered",
    "motion-ideal": "motion",
}
"""Store field of each displacement. `noisy`: true flow with the published noise. `motion`: recovered stereo
motion in three components; `motion-ideal`: its ground truth."""
UNKNOWN_YOUNG_KPA = 1.0  # E assumed where it is unknown: forces are then right up to a factor
RECOVERED = ("recovered", "motion")  # displacements with the errors of an estimator
_MIXED = {"mixed": ("ideal", "recovered"), "motion-mixed": ("motion-ideal", "motion")}
_CURE = {
    "ideal": "render it anew",
    "recovered": "render with flow.backend other than 'ideal'",
    "noisy": "render with store.extra: [flow_noisy]",
    "motion": "render with render.stereo_mm and flow.backend other than 'ideal'",
    "motion-ideal": "render with render.stereo_mm",
}
_ARRAYS = ("mask", "confidence", "density", "force", "motion_confidence")
_PLAIN = ("name", "content_hash", "group", "young_kpa", "opening", "membrane")


@dataclass(frozen=True)
class Clip:
    """One sequence on the grid."""

    name: str
    content_hash: str
    group: str  # sequences of equal group are never on both sides of a split
    young_kpa: float
    mask: Map  # (N, N) 0/1, tissue
    displacement: dict[str, Map]
    """`ideal`, `recovered` and/or `noisy`: (T, 2, N, N) mm in picture axes; `motion` and/or `motion-ideal`:
    (T, 3, N, N) mm in camera axes."""
    confidence: Map  # (T, N, N) 0..1 of the recovered flow; 1 without one
    density: Map
    """(T, 3, N, N) force density per unit stiffness, camera axes [mN/mm² at E = 1 kPa]. Its sum times the
    cell's area times E is the force on the tissue in view: force in cells that are mostly not tissue is moved
    to the nearest tissue cell; only force off the grid is missing."""
    force: Floats  # (T, 3) mN, total force on the tissue, camera axes
    motion_confidence: Map | None = None
    """(T, 2, N, N) 0..1 of recovered stereo motion, across and along the optical axis; None without it."""
    opening: str = ""  # place of the craniotomy on a user's brain; empty for procedural brains
    membrane: MembraneState = "unknown"
    recovered_by: str = ""  # estimator and version of the recovered motion; empty if unknown

    @property
    def frames(self) -> int:
        return len(self.density)

    def confidence_of(self, source: str) -> Map:
        """Confidence in a displacement, (T, 1, N, N), with depth (T, 2, N, N); 1 for ground truth."""
        if source == "recovered":
            return np.asarray(self.confidence)[:, None]
        if source == "motion" and self.motion_confidence is not None:
            return np.asarray(self.motion_confidence)
        return np.broadcast_to(np.float32(1), (self.frames, 1 + has_depth(source), *self.mask.shape))


def has_depth(source: str) -> bool:
    """Whether an input kind or a source is motion in three dimensions, from stereo."""
    return source.startswith("motion")


def scored_source(kind: Input) -> str:
    """The source that a model of an input kind is scored on: of a mixture the recovered one."""
    return sources(kind)[-1]


def sources(kind: Input) -> tuple[str, ...]:
    """Displacements that an input kind uses."""
    return _MIXED.get(kind, (kind,))


def read_clip(sequence: Sequence, grid: Grid, source_names: Iterable[str]) -> Clip:
    """One store on the grid, with the displacements of some names in `FIELDS`. UserError if it lacks one of
    them or tissue, or if values don't match their seal."""
    source_names = tuple(source_names)
    check_readable(sequence, source_names)
    if sequence.attrs.get("young_kpa") is None:
        raise UserError(f"{sequence.path}: lacks the attribute young_kpa; set fem.young_kpa in its job")
    young, scale = (float(sequence.attrs[name]) for name in ("young_kpa", "scale_mm_per_px"))
    tissue, area, force = (sequence.read_whole(name) for name in ("tissue", "area", "force"))
    view = GridView(tissue, scale, grid)

    def on_grid(field: str, prepare: Callable[[Any], Any]) -> Map:
        frames = map(prepare, sequence.read_sealed(field))
        return np.stack([view.mean(frame) * view.mask for frame in frames])

    def displacement(source: str) -> Map:
        mm = 1.0 if has_depth(source) else scale
        return on_grid(FIELDS[source], lambda values: values.transpose(2, 0, 1) * mm)

    confidence, spatial = np.ones((sequence.frames, grid.size, grid.size), np.float32), None
    if "recovered" in source_names and "flow_confidence" in sequence:
        confidence = on_grid("flow_confidence", np.asarray)
    if "motion" in source_names:
        spatial = on_grid("motion_deviation", certainty)
    loads = (traction.transpose(2, 0, 1) * area for traction in sequence.read_sealed("traction"))
    density = np.stack([settle(view.sum(load), view.mask) for load in loads])
    density /= np.float32(grid.pitch_mm**2 * young)
    return Clip(
        **_plain(sequence),
        mask=view.mask,
        displacement={source: displacement(source) for source in source_names},
        confidence=confidence,
        density=density,
        force=force,
        motion_confidence=spatial,
    )


def check_readable(sequence: Sequence, source_names: Iterable[str]) -> None:
    """Raises UserError if a store lacks a displacement of `FIELDS`, or its scale."""
    for source in source_names:
        if FIELDS[source] not in sequence:
            kind = "stereo motion" if has_depth(source) else f"{source} flow"
            alike = (name for name in FIELDS if has_depth(name) is has_depth(source))
            others = [f"use --input {name}" for name in alike if FIELDS[name] in sequence]
            hint = ", or ".join([_CURE[source], *others[:1]])
            raise UserError(f"{sequence.path}: holds no {kind} (field {FIELDS[source]}); {hint}")
    if sequence.attrs.get("scale_mm_per_px") is None:
        raise UserError(f"{sequence.path}: lacks the attribute scale_mm_per_px")


def _plain(sequence: Sequence) -> dict[str, Any]:
    """A clip's fields that come from the attributes."""
    scenario: dict[str, Any] = sequence.attrs.get("scenario") or {}
    tissue = scenario.get("tissue") or {}
    return {
        "name": sequence.path.name,
        "content_hash": sequence.attrs["content_hash"],
        "group": name_anatomy(sequence.attrs),
        "young_kpa": float(sequence.attrs["young_kpa"]),
        "recovered_by": sequence.recovered_by,
        "opening": sequence.attrs.get("opening_id") or "",
        "membrane": ("intact" if tissue.get("membrane") else "stripped") if tissue else "unknown",
    }


def load_clips(
    root: Path,
    grid: Grid,
    source_names: Iterable[str],
    *,
    cache: Path | None = None,
    report: ProgressCallback = lambda done, of: None,
) -> list[Clip]:
    """All sealed sequences of a dataset, in order.

    `cache`: folder of packed arrays, written on first use and memory-mapped after; keyed by content hash,
    grid and the version of packing (`synth.formats.CLIPS`), so it can be shared. Raises UserError for an
    empty dataset, and for a sequence whose attributes or values don't match their seal.
    """
    source_names = tuple(source_names)
    dataset = Dataset(root)
    clips = []
    for i, sequence in enumerate(dataset):
        report(i, len(dataset))
        clip = cache and _pack(sequence, grid, source_names, cache)
        clips.append(clip or read_clip(sequence, grid, source_names))
    report(len(dataset), len(dataset))
    return clips


def _pack(sequence: Sequence, grid: Grid, source_names: tuple[str, ...], cache: Path) -> Clip:
    # A forged content hash can't fill the cache: opening a store checks the hash against the attributes, and
    # reading a field checks its values.
    key = [sequence.attrs["content_hash"], grid.size, grid.extent_mm, *source_names, CLIPS]
    file = cache / f"{identity.digest(key)}.safetensors"
    if not file.is_file():
        pack(read_clip(sequence, grid, source_names), file)
    return replace(unpack(file), **_plain(sequence))


def pack(clip: Clip, file: Path) -> None:
    """Writes a clip as one file, as a process may have 65,530 mappings. UserError: can't be written."""
    arrays = {name: getattr(clip, name) for name in _ARRAYS if getattr(clip, name) is not None}
    arrays |= {f"displacement-{source}": values for source, values in clip.displacement.items()}
    arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    plain = {name: getattr(clip, name) for name in _PLAIN} | {"checksum": _checksum(arrays)}
    with as_user_error(f"{file}: cannot be written"):
        file.parent.mkdir(parents=True, exist_ok=True)
        with checked_file.part_of(file) as part:
            save_file(arrays, part, metadata={"clip": json.dumps(plain)})


def unpack(file: Path) -> Clip:
    """A packed clip, memory-mapped; no file stays open. Raises UserError if it is not one, or damaged."""
    checked_file.check_file(file, 64 << 30)
    with as_user_error(f"{file}: can't be read as a packed sequence"):
        with safe_open(file, "pt") as archive:
            plain = json.loads(archive.metadata()["clip"])
            arrays = {name: archive.get_tensor(name).numpy() for name in archive.keys()}  # noqa: SIM118
        if plain.pop("checksum") != _checksum(arrays):
            raise ValueError("damaged: the checksum does not match")
        for array in arrays.values():
            array.flags.writeable = False
        stored = [source for source in FIELDS if f"displacement-{source}" in arrays]
        displacement = {source: arrays.pop(f"displacement-{source}") for source in stored}
        return Clip(**plain, displacement=displacement, **arrays)


def _checksum(arrays: Mapping[str, Array]) -> int:
    checksum = 0
    for name in sorted(arrays):
        checksum = zlib.crc32(arrays[name].reshape(-1).view(np.uint8).data, checksum)
    return checksum


def target(clip: Clip, frame: int, components: int) -> Map:
    """Training target of a frame (C, N, N): force density, or with one component its length."""
    density = np.asarray(clip.density[frame])
    if components == 3:
        return density
    return np.asarray(np.sqrt(np.square(density).sum(0, keepdims=True)))


def amount(clip: Clip, components: int, pitch_mm: float) -> Floats:
    """True total force that a map of C components is compared with, (T, C) [mN at E = 1 kPa]: for lengths
    their sum, in which two jaws that pull against each other add up."""
    if components == 3:
        return clip.force / clip.young_kpa
    length = np.sqrt(np.square(np.asarray(clip.density), dtype=np.float64).sum(1))
    return np.asarray(length.sum((1, 2))[:, None] * pitch_mm**2)
