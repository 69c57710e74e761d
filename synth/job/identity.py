"""The identity of a job: a hash that is equal exactly if the sequences are equal."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from synth.errors import UserError
from synth.job.mechanics_sections import is_mesh_name
from synth.job.schema import Job
from synth.system import camera_file, checked_file
from synth.system.series_files import LARGEST_STATE, list_files

FILES: dict[tuple[str, str], int] = {
    ("anatomy", "mesh"): checked_file.LARGEST_MESH,
    ("appearance", "photo"): checked_file.LARGEST_PICTURE,
    ("render", "calibration"): camera_file.LARGEST_FILE,
}
"""Keys of a job that are files, as (section, key), and the largest size of such a file in bytes."""
_PICTURES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")


def canonical(value: Any) -> bytes:
    """JSON with sorted keys and no spaces; the same value gives the same bytes. ValueError for NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest(value: Any) -> str:
    """Hash of a value's canonical JSON. ValueError for NaN."""
    return hashlib.blake2b(canonical(value), digest_size=16).hexdigest()


def identify_job(job: Job) -> str:
    """Hash of everything that a sequence of `job` depends on except its index.

    Files enter by content, not by path. The card and the number of sequences don't enter: sequence 3 is the
    same in a dataset of 24 and of 48, so a dataset can be extended.
    """
    values = job.model_dump(mode="json")
    del values["sequences"], values["card"]
    for (block, name), largest in FILES.items():
        values[block][name] = _digest_file(getattr(getattr(job, block), name), largest)
    for *steps, key in find_meshes(values):
        holder: Any = values
        for step in steps:
            holder = holder[step]
        file = Path(holder[key])
        holder[key] = [file.name, _digest_file(file, checked_file.LARGEST_INSTRUMENT)]
    if job.mechanics.source is not None:
        files = list_files(job.mechanics.source, job.mechanics.force, job.mechanics.instruments)
        values["mechanics"]["source"] = [_digest_file(file, LARGEST_STATE) for file in files]
    return digest(values)


def find_meshes(values: dict[str, Any]) -> list[tuple[str | int, ...]]:
    """Places of the files of instruments in a job's values, as read or as dumped."""
    fem = values.get("fem")
    if not isinstance(fem, dict):
        return []
    tools, lines = fem.get("instrument"), fem.get("instrument_list")
    candidates: list[tuple[tuple[str | int, ...], Any]] = [(("fem", "instrument"), tools)]
    if isinstance(tools, list | tuple):
        candidates = [(("fem", "instrument", k), tool) for k, tool in enumerate(tools)]
    for k, line in enumerate(lines if isinstance(lines, list | tuple) else ()):
        if isinstance(line, dict):
            candidates.append((("fem", "instrument_list", k, "instrument"), line.get("instrument")))
    places = list[tuple[str | int, ...]]()
    for place, tool in candidates:
        if is_mesh_name(tool):
            places.append(place)
        elif isinstance(tool, dict) and isinstance(tool.get("file"), str):
            places.append((*place, "file"))
    return places


def list_pictures(folder: Path) -> list[Path]:
    """Pictures in a folder of `appearance.photo`. UserError: there are none."""
    pictures = sorted(
        path for path in folder.iterdir() if path.suffix.lower() in _PICTURES and path.is_file()
    )
    if not pictures:
        raise UserError(f"appearance.photo: {folder} holds no picture ({' '.join(_PICTURES)})")
    return pictures


def identify_anatomy(job: Job, seed: int, at_rest: bytes | None = None) -> str:
    """Name of a sequence's geometry, equal in all datasets: a user's brain, or the seed of a procedural one.

    A brain is one anatomy for all its craniotomies and for all vessels drawn on it. `at_rest`: coordinates of
    the surface of `mechanics.source`.
    """
    mesh = _digest_file(job.anatomy.mesh, FILES["anatomy", "mesh"])
    if at_rest is not None:
        mesh = hashlib.blake2b(at_rest, digest_size=16).hexdigest()
    return f"seed-{seed}" if mesh is None else f"mesh-{mesh[:16]}"


def identify_opening(job: Job, index: int, anatomy: str) -> str:
    """Name of the craniotomy of a user's brain with the name `anatomy`, equal in all datasets."""
    point = job.anatomy.select_opening(index).craniotomy.point or ()
    return f"{anatomy} at " + ", ".join(f"{value:g}" for value in point)


def _digest_file(path: Path | None, largest: int) -> str | None:
    if path is None:
        return None
    if path.is_dir():
        return digest([_digest_file(picture, largest) for picture in list_pictures(path)])
    with checked_file.open_file(path, largest) as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
