"""DICOM: pictures of many frames, or a video inside, read by pydicom."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.importers.importer_registry import LARGEST_BYTES, MOST_FRAMES
from synth.arrays import Array, Floats
from synth.errors import UserError
from synth.system import checked_file
from synth.system.checked_file import refuse_large
from synth.video.read_video import read_video

SUFFIXES = (".dcm", ".dicom")
_VIDEO = "1.2.840.10008.1.2.4.10"  # what the transfer syntaxes of MPEG-2, H.264 and H.265 begin with


def open_dicom(source: Path, notes: list[str]) -> tuple[Callable[[], Iterator[Array]], int, Floats | None]:
    """The pictures of a file, how many, and their times (T,) s if it states them. UserError: it has none."""
    from pydicom import dcmread
    from pydicom.errors import InvalidDicomError

    checked_file.check_file(source, LARGEST_BYTES)
    try:
        dataset = dcmread(source, defer_size=4096)
    except InvalidDicomError:
        raise UserError(f"{source}: no DICOM file: its preamble is missing") from None
    if "PixelData" not in dataset:
        kind = getattr(dataset, "Modality", "unknown modality")
        raise UserError(f"{source}: a DICOM file ({kind}) without pictures")
    if str(dataset.file_meta.TransferSyntaxUID).startswith(_VIDEO):
        video = _ExtractedVideo(dataset)
        times = [picture.time_s for picture in read_video(video.path)]
        return video, len(times), np.array(times, np.float64)
    refuse_large(int(dataset.Columns), int(dataset.Rows))
    count = int(getattr(dataset, "NumberOfFrames", 1) or 1)
    if count > MOST_FRAMES:
        raise UserError(f"{source}: {count} frames, at most {MOST_FRAMES} are read")

    def pictures() -> Iterator[Array]:
        from pydicom.pixels import iter_pixels

        return (_interpret_values(picture, dataset) for picture in iter_pixels(source))

    return pictures, count, _times(dataset, count, notes)


def _interpret_values(picture: Array, dataset: Any) -> Array:
    """Stored values (H, W) or (H, W, 3) as grey that rises with brightness, or as RGB; uint8 or uint16."""
    kind = str(dataset.PhotometricInterpretation)
    if kind == "PALETTE COLOR":
        from pydicom.pixels import apply_color_lut

        return np.asarray(apply_color_lut(picture, dataset))
    if kind == "MONOCHROME1":  # 0 is white; bits above those stored may hold something else
        white = picture.dtype.type((1 << int(dataset.BitsStored)) - 1)
        return np.asarray(white - (picture & white))
    return picture


class _ExtractedVideo:
    """The video inside a file, in a temporary one for as long as this object lives."""

    def __init__(self, dataset: Any) -> None:
        from pydicom.encaps import generate_fragments

        self._file = tempfile.NamedTemporaryFile(suffix=".ts")  # noqa: SIM115  # deleted with this object
        for fragment in list(generate_fragments(dataset.PixelData))[1:]:  # after the table of offsets
            self._file.write(fragment)
        self._file.flush()
        self._negative = str(getattr(dataset, "PhotometricInterpretation", "")) == "MONOCHROME1"
        self.path = Path(self._file.name)

    def __call__(self) -> Iterator[Array]:
        pictures = (picture.rgb for picture in read_video(self.path))
        return (255 - rgb for rgb in pictures) if self._negative else pictures


def _times(dataset: Any, count: int, notes: list[str]) -> Floats | None:
    """Times (T,) s by the frames' stated intervals or rate; None: none is stated."""
    steps = getattr(dataset, "FrameTimeVector", None)
    if steps is not None and np.size(steps) == count:
        return np.asarray(np.cumsum(np.array(steps, np.float64)) / 1000 - float(steps[0]) / 1000, np.float64)
    interval_ms = float(getattr(dataset, "FrameTime", 0) or 0)
    rate = float(getattr(dataset, "CineRate", 0) or getattr(dataset, "RecommendedDisplayFrameRate", 0) or 0)
    if interval_ms > 0:
        return np.arange(count) * interval_ms / 1000
    if rate > 0:
        notes.append(f"times are those of the stated rate of display, {rate:g} a second")
        return np.arange(count) / rate
    return None
