"""PLUS/IGSIO sequences: a MetaImage with header fields for every frame, read by SimpleITK."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.importers.registry import LARGEST_BYTES, MOST_FRAMES, Intake, one_of
from synth.arrays import Floats, Pixels
from synth.errors import UserError
from synth.system import checked_file
from synth.system.checked_file import refuse_large

_LONGEST_LINE = 65536
_FIELD = re.compile(r"Seq_Frame(\d+)_(.+)")
Fields = dict[str, dict[int, str]]  # text of a field by name and frame


def read_source(source: Path, use: dict[str, str]) -> Intake:
    """Opens a sequence with the fields `Timestamp` and `Force`. UserError for another format, or no times."""
    import SimpleITK

    _refuse_elsewhere(source)
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(source))
    reader.ReadImageInformation()
    fields: Fields = {}
    for key in reader.GetMetaDataKeys():
        if match := _FIELD.fullmatch(key):
            fields.setdefault(match[2], {})[int(match[1])] = reader.GetMetaData(key)
    size = reader.GetSize()
    if len(size) != 3 or size[2] > MOST_FRAMES:
        raise UserError(f"{source}: not a sequence of pictures, or one of more than {MOST_FRAMES} frames")
    count = size[2]
    refuse_large(size[0], size[1])
    stamp = use.get("frame_time", "Timestamp")
    if stamp not in fields:
        raise UserError(
            f"{source}: frames have no field {stamp}; there are {', '.join(sorted(fields)) or 'none'}"
        )
    times = _column(source, stamp, fields[stamp], count, (1,))[:, 0]
    notes: list[str] = []
    force = _force(source, fields, count, use, notes)
    if "UltrasoundImageOrientation" in reader.GetMetaDataKeys():
        orientation = reader.GetMetaData("UltrasoundImageOrientation")
        notes.append(f"orientation {orientation}: pictures are imported as stored")

    def pictures() -> Iterator[Pixels]:
        for k in range(count):
            reader.SetExtractIndex([0, 0, k])
            reader.SetExtractSize([size[0], size[1], 0])
            yield SimpleITK.GetArrayFromImage(reader.Execute())

    good = np.isfinite(force).all(axis=1) if len(force) else np.zeros(0, bool)
    return Intake(times, pictures, times[: len(force)][good], force[good], tuple(notes))


def _refuse_elsewhere(source: Path) -> None:
    """Raises UserError for a header that names another file for its pictures, or is not a MetaImage's."""
    with checked_file.open_file(source, LARGEST_BYTES) as file:
        while line := file.readline(_LONGEST_LINE):
            key, _, value = line.partition(b"=")
            if key.strip() == b"ElementDataFile":
                if value.strip() == b"LOCAL":
                    return
                raise UserError(f"{source}: its pictures are in another file, which is not opened; use .mha")
            if not value or len(line) == _LONGEST_LINE:
                break
    raise UserError(f"{source}: not a readable MetaImage")


def _force(source: Path, fields: Fields, count: int, use: dict[str, str], notes: list[str]) -> Floats:
    """(T, 3), NaN where a frame has none; (0, 3) without a field of force."""
    names = sorted(fields) if "force" in use else [name for name in fields if name.lower() == "force"]
    name = one_of("force", use.get("force"), names, "field")
    if name is None:
        return np.zeros((0, 3))
    force = _column(source, name, fields[name], count, (1, 3))
    if force.shape[1] == 1:
        notes.append(f"{name} is one number per frame: imported as a magnitude, in fx_n")
        force = np.column_stack([force, np.zeros((count, 2))])
    return force


def _column(source: Path, name: str, values: dict[int, str], count: int, widths: tuple[int, ...]) -> Floats:
    """(T, width) numbers of a field; NaN where a frame lacks it."""
    rows = {k: text.split() for k, text in values.items() if k < count}
    width = max((len(row) for row in rows.values()), default=0)
    if width not in widths:
        raise UserError(f"{source}: field {name} holds {width} numbers per frame, expected {widths[-1]}")
    out = np.full((count, width), np.nan)
    for k, row in rows.items():
        if len(row) != width:  # a single number would be broadcast
            raise UserError(f"{source}: field {name} of frame {k} is not {width} numbers")
        out[k] = [float(word) for word in row]
    return out
