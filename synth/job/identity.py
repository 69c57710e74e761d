"""The identity of a job: a hash that is equal exactly if the sequences are equal."""

from __future__ import annotations

import hashlib
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from synth.errors import UserError, as_user_error
from synth.job.mechanics_sections import LARGEST_MESH, is_mesh_name
from synth.job.schema import Job, MechanicsSection, table_of
from synth.system import camera_file, checked_file

FILES: dict[tuple[str, str], int] = {
    ("anatomy", "mesh"): 1 << 30,
    ("appearance", "photo"): checked_file.LARGEST_PICTURE,
    ("render", "calibration"): camera_file.LARGEST_FILE,
}
"""Keys of a job that are files, as (section, key), and the largest size of such a file in bytes."""
LARGEST_STATE, _LARGEST_LIST = 2 << 30, 32 << 20  # bytes of a file of a series, of a collection of them
COLLECTIONS = (".pvd", ".series")  # suffixes of files that name those of a series
_PICTURES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_OF_SERIES = (*COLLECTIONS, ".vtu", ".vtk", ".vtp", ".npz", ".obj", ".ply", ".glb")
_MOST_STATES = 20_000  # of a collection, which may name one file again and again


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
    for at in find_meshes(described):
        place: Any = described
        for step in at[:-1]:
            place = place[step]
        file = Path(place[at[-1]])
        place[at[-1]] = [file.name, _digest_file(file, LARGEST_MESH)]
    if job.mechanics.source is not None:
        files = list_files(job.mechanics)
        described["mechanics"]["source"] = [_digest_file(file, LARGEST_STATE) for file in files]
    return digest(described)


def find_meshes(values: dict[str, Any]) -> list[tuple[str | int, ...]]:
    """Places of the files of instruments in a job's values, as read or as dumped."""
    found, fem = list[tuple[str | int, ...]](), values.get("fem")
    if not isinstance(fem, dict):
        return found
    tools, lines = fem.get("instrument"), fem.get("instrument_list")
    each: list[tuple[tuple[str | int, ...], Any]] = [(("fem", "instrument"), tools)]
    if isinstance(tools, list | tuple):
        each = [(("fem", "instrument", k), tool) for k, tool in enumerate(tools)]
    for k, line in enumerate(lines if isinstance(lines, list | tuple) else ()):
        if isinstance(line, dict):
            each.append((("fem", "instrument_list", k, "instrument"), line.get("instrument")))
    for at, tool in each:
        if is_mesh_name(tool):
            found.append(at)
        elif isinstance(tool, dict) and isinstance(tool.get("file"), str):
            found.append((*at, "file"))
    return found


def list_sources(mechanics: MechanicsSection) -> list[Path]:
    """Sources of the sequences: folders that a pattern such as `runs/*/` names, or the source itself."""
    source = mechanics.source
    assert source is not None
    folders = sorted(one for one in source.parent.glob(source.name) if one.is_dir())
    return folders if "*" in source.name and folders else [source]


def inside(folder: Path, name: str) -> Path:
    """The file that a series names in its folder. UserError: it is elsewhere, also by a link."""
    path = Path(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name:
        raise UserError(f"{folder}: {name} is not in its folder; copy the file there")
    if not (folder / path).resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{folder / path}: is a link out of its folder; copy the file there")
    return folder / path


def list_files(mechanics: MechanicsSection) -> list[Path]:
    """Files that series and tables of all sequences consist of. UserError: there are none."""
    found, tables = list[Path](), (table_of(mechanics.force), mechanics.instruments)
    for source in list_sources(mechanics):
        folder = source if source.is_dir() else source.parent
        named = folder.iterdir() if source.is_dir() else folder.glob(source.name)
        files = [source] if source.is_file() else sorted(one for one in named if one.suffix in _OF_SERIES)
        lists = [one for one in files if one.suffix in COLLECTIONS]
        if len(lists) == 1:  # which is then read instead of numbered files
            files += [file for file, _ in read_collection(lists[0])]
        found += [*files, *(inside(folder, one) for one in tables if one is not None)]
    if not (found := [file for file in dict.fromkeys(found) if file.is_file()]):
        raise UserError(f"mechanics.source: no file is named by {mechanics.source}")
    return found


def read_collection(source: Path) -> list[tuple[Path, float]]:
    """Files and times of a .pvd or .series file. UserError if it is neither, or lists fewer than two."""
    text = checked_file.read_text(source, _LARGEST_LIST)
    with as_user_error(f"{source}: is not a collection of files"):
        if "<!ENTITY" in text:
            raise ValueError("it declares entities")
        if source.suffix == ".pvd":
            sets = [one.attrib for one in ET.fromstring(text).iter("DataSet")]
            if len({one.get("part", "0") for one in sets}) > 1:
                raise ValueError("it has several parts at a time; choose one by a pattern")
            found = [(one["file"], float(one["timestep"])) for one in sets]
        else:
            found = [(one["name"], float(one["time"])) for one in json.loads(text)["files"]]
        if not 2 <= len(found) <= _MOST_STATES:
            raise ValueError(f"it lists {len(found)} files, 2 to {_MOST_STATES} are possible")
        return [(inside(source.parent, name), time) for name, time in found]


def list_pictures(folder: Path) -> list[Path]:
    """Pictures in a folder of `appearance.photo`. UserError: there are none."""
    found = sorted(one for one in folder.iterdir() if one.suffix.lower() in _PICTURES and one.is_file())
    if not found:
        raise UserError(f"appearance.photo: {folder} holds no picture ({' '.join(_PICTURES)})")
    return found


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
    if path.is_dir():
        return digest([_digest_file(one, largest) for one in list_pictures(path)])
    with checked_file.open_file(path, largest) as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
