"""PLUS/IGSIO sequences: a MetaImage with header fields for every frame; pictures in it, or in a video
beside it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PureWindowsPath

import numpy as np

from bench.importers.importer_registry import LARGEST_BYTES, MOST_FRAMES, Intake, choose_name
from bench.recording.sensor_table import Readings
from synth.arrays import Floats, Pixels
from synth.errors import UserError, first_line
from synth.system import checked_file
from synth.system.checked_file import refuse_large
from synth.video import read_video as video

SUFFIXES = (".mha",)
_LONGEST_LINE = 65536
_FIELD = re.compile(r"Seq_Frame(\d+)_(.+)")
_SPARE = 2  # frames by which a video may be longer or shorter than its sequence
_NO_PIXELS = "MET_NONE"
Fields = dict[str, dict[int, str]]  # text of a field by name and frame


@dataclass(frozen=True)
class Header:
    """The text of a sequence."""

    source: Path
    fields: dict[str, str]  # fields of the whole
    frames: Fields
    count: int  # of frames
    has_pixels: bool

    def error(self, fault: str) -> UserError:
        return UserError(f"{self.source}: {fault}")


def read_source(source: Path, use: dict[str, str]) -> Intake:
    """Opens a sequence with the fields `Timestamp` and `Force`; of six numbers of force the first three
    count.

    Without pixels its pictures are those of the `VideoFile` in the same folder. What has the status
    INVALID is left out: forces, poses and pictures. UserError for another format, no times, or no such video.
    """
    header = read_header(source)
    times = _times(header, use)
    notes: list[str] = []
    force, axes = _force(header, use, notes)
    if "UltrasoundImageOrientation" in header.fields and header.has_pixels:
        orientation = header.fields["UltrasoundImageOrientation"]
        notes.append(f"orientation {orientation}: pictures are imported as stored")
    film = None
    if header.has_pixels:
        indices = _find_valid(header, "Image")
        pictures: Callable[[], Iterator[Pixels]] = _Pixels(header, indices)
    else:
        path = _find_film(header)
        count = video.count_frames(path) or 0
        indices = _match_film(header, path.name, count, notes)
        pictures = _Film(path, len(indices))
        film = path if count == header.count else None
    if len(indices) < header.count:
        notes.append(
            f"{header.count - len(indices)} of {header.count} frames have no picture and are left out"
        )
    poses = {name: rows[indices] for name, rows in _poses(header).items()}
    is_valid = np.isfinite(force).all(axis=1) & np.isfinite(times) if len(force) else np.zeros(0, bool)
    if len(force) and (lost_count := int(header.count - is_valid.sum())):
        notes.append(f"{lost_count} of {header.count} frames have no valid force")
    return Intake(
        times[indices],
        pictures,
        times[: len(force)][is_valid],
        force[is_valid],
        tuple(notes),
        axes=axes,
        film=film,
        poses=poses,
    )


def read_forces(source: Path) -> Readings:
    """Times and forces of a sequence alone, as a table of them. UserError: it has none."""
    header, notes = read_header(source), list[str]()
    times = _times(header, {})
    force, axes = _force(header, {}, notes)
    if not len(force):
        raise header.error(f"frames have no field Force; there are {_names(header.frames)}")
    is_valid = np.isfinite(force).all(axis=1) & np.isfinite(times)
    return Readings(times[is_valid], force[is_valid], axes, False, tuple(notes))


def read_header(source: Path) -> Header:
    """The fields of a MetaImage. UserError: it is none, has other dimensions, or pictures in another file."""
    fields, frames, data_file = dict[str, str](), Fields(), ""
    with checked_file.open_file(source, LARGEST_BYTES) as file:
        while line := file.readline(_LONGEST_LINE):
            key, equals, value = (part.strip() for part in line.decode("utf-8", "replace").partition("="))
            if not line.strip():
                continue
            if not equals or len(line) == _LONGEST_LINE:
                start = ascii(line[:60].decode("latin-1").strip())
                raise UserError(f"{source}: no MetaImage: after {len(fields)} fields it goes on with {start}")
            if match := _FIELD.fullmatch(key):
                frames.setdefault(match[2], {})[int(match[1])] = value
            else:
                fields[key] = value
            if key == "ElementDataFile":
                data_file = value
                break
    element_type = fields.get("ElementType", "")
    has_pixels = element_type not in ("", _NO_PIXELS)
    if has_pixels and data_file != "LOCAL":
        raise UserError(
            f"{source}: its pictures ({element_type}) are in another file, {data_file or 'not named'}, which "
            "is not opened; "
            "save it as one .mha"
        )
    sizes = [int(word) for word in fields.get("DimSize", "").split() if word.isdigit()]
    if len(sizes) not in (3, 4) or not 0 < sizes[-1] <= MOST_FRAMES or (len(sizes) == 4 and sizes[2] != 1):
        raise UserError(
            f"{source}: not a sequence of pictures: ElementType {element_type or 'not stated'}, "
            f"DimSize {fields.get('DimSize', 'not stated')}; needed are width, height and at most "
            f"{MOST_FRAMES} frames"
        )
    return Header(source, fields, frames, sizes[-1], has_pixels)


class _Pixels:
    """The pictures in a sequence, those of some frames in order."""

    def __init__(self, header: Header, indices: Sequence[int]) -> None:
        """UserError if they can't be read."""
        import SimpleITK

        self._indices = indices
        self._reader = SimpleITK.ImageFileReader()
        self._reader.SetFileName(str(header.source))
        try:
            self._reader.ReadImageInformation()
        except RuntimeError as error:
            kind = header.fields.get("ElementType")
            raise header.error(
                f"pictures of ElementType {kind} can't be read ({first_line(error)})"
            ) from None
        self._size = self._reader.GetSize()
        if len(self._size) != 3:
            raise header.error(f"not a sequence of pictures: {len(self._size)} dimensions")
        refuse_large(self._size[0], self._size[1])

    def __call__(self) -> Iterator[Pixels]:
        import SimpleITK

        for k in self._indices:
            self._reader.SetExtractIndex([0, 0, int(k)])
            self._reader.SetExtractSize([self._size[0], self._size[1], 0])
            yield SimpleITK.GetArrayFromImage(self._reader.Execute())


@dataclass(frozen=True)
class _Film:
    """The first pictures of a video."""

    path: Path
    count: int

    def __call__(self) -> Iterator[Pixels]:
        return (picture.rgb for picture in islice(video.read_video(self.path), self.count))


def _find_film(header: Header) -> Path:
    """The video that a sequence without pixels names, in its own folder. UserError: there is none."""
    # Recorders write whole paths of their system.
    name = PureWindowsPath(header.fields.get("VideoFile", "")).name
    if not name:
        raise header.error(
            f"no pictures: ElementType {header.fields.get('ElementType', 'not stated')}, and no "
            "VideoFile is named"
        )
    folder = header.source.resolve().parent
    path = header.source.parent / name
    if not path.exists():
        raise header.error(f"its pictures are in {name}, which is not in the same folder: copy it there")
    if path.resolve().parent != folder or path.suffix.lower() not in video.SUFFIXES:
        raise header.error(f"VideoFile {name} is no video in the same folder")
    return path


def _match_film(header: Header, film: str, pictures: int, notes: list[str]) -> list[int]:
    """The frames that a video of so many pictures shows. UserError: it has many more, or fewer."""
    if abs(pictures - header.count) > _SPARE:
        raise header.error(
            f"{header.count} frames, but {film} has {pictures} pictures: which is of which "
            "can't be told; "
            f"import {film} with --use force={header.source.name} and --use frame_time=TABLE.csv"
        )
    if pictures != header.count:
        notes.append(f"{film} has {pictures} pictures for {header.count} frames: matched from the first on")
    return list(range(min(pictures, header.count)))


def _times(header: Header, use: dict[str, str]) -> Floats:
    stamp = use.get("frame_time", "Timestamp")
    if stamp not in header.frames:
        raise header.error(f"frames have no field {stamp}; there are {_names(header.frames)}")
    times = _column(header, stamp, (1,))[:, 0]
    if not np.isfinite(times).all():
        raise header.error(f"{np.sum(~np.isfinite(times))} of {header.count} frames have no {stamp}")
    return times


def _names(frames: Fields) -> str:
    return ", ".join(sorted(frames)) or "none"


def _force(header: Header, use: dict[str, str], notes: list[str]) -> tuple[Floats, str]:
    """(T, 3), NaN where a frame has none, and its axes; (0, 3) without a field of force."""
    numbers = [name for name in sorted(header.frames) if not name.endswith(("Status", "Transform"))]
    names = numbers if "force" in use else [name for name in numbers if name.lower() == "force"]
    name = choose_name("force", use.get("force"), names, "field")
    if name is None:
        notes.append(f"no field Force; the frames have {_names(header.frames)}")
        return np.zeros((0, 3)), "xyz"
    force = _column(header, name, (1, 3, 6))
    if force.shape[1] == 1:
        notes.append(f"{name} is one number per frame: only the size is scored")
        return np.column_stack([force, np.zeros((header.count, 2))]), ""
    if force.shape[1] == 6:
        notes.append(f"{name} holds six numbers: the first three are the force")
    return force[:, :3], "xyz"


def _find_valid(header: Header, name: str) -> list[int]:
    """The frames of which something has no status, or another one than INVALID."""
    status = header.frames.get(f"{name}Status", {})
    return [k for k in range(header.count) if status.get(k, "OK").upper() != "INVALID"]


def _poses(header: Header) -> dict[str, Floats]:
    """Rigid transforms (T, 4, 4) by name, as stored; NaN where a frame lacks one or its status is INVALID."""
    names = [name for name in sorted(header.frames) if name.endswith("Transform")]
    return {name: _column(header, name, (16,)).reshape(-1, 4, 4) for name in names}


def _column(header: Header, name: str, widths: tuple[int, ...]) -> Floats:
    """(T, width) numbers of a field; NaN where a frame lacks it or its status is INVALID."""
    valid = set(_find_valid(header, name))
    rows = {k: text.split() for k, text in header.frames[name].items() if k in valid}
    width = max((len(row) for row in rows.values()), default=widths[-1])
    if width not in widths:
        expected = " or ".join(map(str, widths))
        raise header.error(f"field {name} holds {width} numbers per frame, expected {expected}")
    columns = np.full((header.count, width), np.nan)
    for k, row in rows.items():
        if len(row) != width:  # a single number would be broadcast
            raise header.error(f"field {name} of frame {k} is not {width} numbers")
        try:
            columns[k] = [float(word) for word in row]
        except ValueError:
            raise header.error(f"field {name} of frame {k} is not numbers: {' '.join(row)[:60]}") from None
    return columns
