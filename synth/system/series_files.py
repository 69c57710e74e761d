"""Which files a series of another program consists of, by the keys of a job's section `mechanics`."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path

from synth.errors import UserError, as_user_error
from synth.system import checked_file

LARGEST_STATE, _LARGEST_LIST = 2 << 30, 32 << 20  # bytes of a file of a series, of a collection of them
COLLECTIONS = (".pvd", ".series")  # suffixes of files that name those of a series
_OF_SERIES = (*COLLECTIONS, ".vtu", ".vtk", ".vtp", ".npz", ".obj", ".ply", ".glb")
_MOST_STATES = 20_000  # of a collection, which may name one file again and again


def table_of(force: str | None) -> str | None:
    """The table that `mechanics.force` names; None if it names a field, or nothing."""
    return force if force is not None and force.lower().endswith(".csv") else None


def list_sources(source: Path) -> list[Path]:
    """Sources of the sequences: folders that a pattern such as `runs/*/` names, or the source itself."""
    folders = sorted(path for path in source.parent.glob(source.name) if path.is_dir())
    return folders if "*" in source.name and folders else [source]


def resolve_inside(folder: Path, name: str) -> Path:
    """The file that a series names in its folder. UserError: it is elsewhere, also by a link."""
    path = Path(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name:
        raise UserError(f"{folder}: {name} is not in its folder; copy the file there")
    if not (folder / path).resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{folder / path}: is a link out of its folder; copy the file there")
    return folder / path


def list_files(source: Path, force: str | None, instruments: str | None) -> list[Path]:
    """Files that series and tables of all sequences consist of; `force` and `instruments` may name tables.

    UserError: there are none.
    """
    paths, tables = list[Path](), (table_of(force), instruments)
    for place in list_sources(source):
        folder = place if place.is_dir() else place.parent
        candidates = folder.iterdir() if place.is_dir() else folder.glob(place.name)
        files = (
            [place] if place.is_file() else sorted(path for path in candidates if path.suffix in _OF_SERIES)
        )
        collections = [path for path in files if path.suffix in COLLECTIONS]
        if len(collections) == 1:  # which is then read instead of numbered files
            files += [file for file, _ in read_collection(collections[0])]
        paths += [*files, *(resolve_inside(folder, name) for name in tables if name is not None)]
    if not (existing := [file for file in dict.fromkeys(paths) if file.is_file()]):
        raise UserError(f"mechanics.source: no file is named by {source}")
    return existing


def read_collection(source: Path) -> list[tuple[Path, float]]:
    """Files and times of a .pvd or .series file. UserError if it is neither, or lists fewer than two."""
    text = checked_file.read_text(source, _LARGEST_LIST)
    with as_user_error(f"{source}: is not a collection of files"):
        if "<!ENTITY" in text:
            raise ValueError("it declares entities")
        if source.suffix == ".pvd":
            sets = [entry.attrib for entry in ET.fromstring(text).iter("DataSet")]
            if len({entry.get("part", "0") for entry in sets}) > 1:
                raise ValueError("it has several parts at a time; choose one by a pattern")
            states = [(entry["file"], float(entry["timestep"])) for entry in sets]
        else:
            states = [(entry["name"], float(entry["time"])) for entry in json.loads(text)["files"]]
        if not 2 <= len(states) <= _MOST_STATES:
            raise ValueError(f"it lists {len(states)} files, 2 to {_MOST_STATES} are possible")
        return [(resolve_inside(source.parent, name), time) for name, time in states]
