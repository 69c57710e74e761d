"""The identity of a job: a hash that is equal exactly if the sequences are equal."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

from synth.errors import UserError
from synth.job.schema import Job, MechanicsSection
from synth.system import camera_file, checked_file

FILES: dict[tuple[str, str], int] = {
    ("anatomy", "mesh"): 1 << 30,
    ("appearance", "photo"): checked_file.LARGEST_PICTURE,
    ("render", "calibration"): camera_file.LARGEST_FILE,
}
"""Keys of a job that are files, as (section, key), and the largest size of such a file in bytes."""
_LARGEST_STATE, _LARGEST_LIST = 2 << 30, 32 << 20
COLLECTIONS = (".pvd", ".series")  # suffixes of files that name those of a series
_NAMED = re.compile(r'(?:\bfile=|"name"\s*:\s*)"([^"]+)"')
_OF_SERIES = (*COLLECTIONS, ".vtu", ".vtk", ".vtp", ".npz", ".obj")


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
    described = job.model_dump(mode="json")
    del described["sequences"], described["card"]
    for (block, name), largest in FILES.items():
        described[block][name] = _digest_file(getattr(getattr(job, block), name), largest)
    if job.mechanics.source is not None:
        files = list_files(job.mechanics)
        described["mechanics"]["source"] = [_digest_file(file, _LARGEST_STATE) for file in files]
    return digest(described)


def list_sources(mechanics: MechanicsSection) -> list[Path]:
    """Sources of the sequences: folders that a pattern such as `runs/*/` names, or the source itself."""
    source = mechanics.source
    assert source is not None
    folders = sorted(one for one in source.parent.glob(source.name) if one.is_dir())
    return folders if "*" in source.name and folders else [source]


def list_files(mechanics: MechanicsSection) -> list[Path]:
    """Files that series and tables of all sequences consist of. UserError: there are none."""
    found = list[Path]()
    for source in list_sources(mechanics):
        folder = source if source.is_dir() else source.parent
        files = (
            [source]
            if source.is_file()
            else folder.iterdir()
            if source.is_dir()
            else folder.glob(source.name)
        )
        found += [one for one in sorted(files) if one.suffix in _OF_SERIES]
        for one in [one for one in found if one.suffix in COLLECTIONS]:
            text = checked_file.read_text(one, _LARGEST_LIST)
            found += [one.parent / name for name in _NAMED.findall(text)]
        force = mechanics.force if (mechanics.force or "").lower().endswith(".csv") else None
        found += [folder / one for one in (force, mechanics.instruments) if one is not None]
    if not (named := [file for file in dict.fromkeys(found) if file.is_file()]):
        raise UserError(f"mechanics.source: no file is named by {mechanics.source}")
    return named


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
    point = job.anatomy.opened(index).craniotomy.point or ()
    return f"{anatomy} at " + ", ".join(f"{value:g}" for value in point)


def _digest_file(path: Path | None, largest: int) -> str | None:
    if path is None:
        return None
    with checked_file.open_file(path, largest) as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
