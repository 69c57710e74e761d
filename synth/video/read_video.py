"""The video reader: pictures with exact times, one at a time, from a video file or a folder of PNGs."""

from __future__ import annotations

import os
import struct
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import TypeVar

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from numpy.typing import NDArray

from synth.arrays import Array, Mask, Pixels
from synth.errors import UserError
from synth.system import checked_file
from synth.system.checked_file import LARGEST_PIXELS, refuse_large
from synth.video.file_numbers import find_stills, number_files, still_times
from synth.video.suffixes import SUFFIXES as SUFFIXES

A = TypeVar("A", bound=np.generic)

FPS = 25.0  # assumed if a video's times are unknown

_LARGEST_BYTES = 1 << 40
_WIDEST = 4.0  # largest aspect ratio of a pixel: a larger one is a damaged header
_PEEKED = 2000  # packets in which a film has more than one picture
_LABELS = 8  # most levels of a mask of class numbers; more are a soft edge

# Formats that FFmpeg may open: others could make it read further files and addresses.
_FORMATS = "mov,matroska,webm,avi,mpegts,mpeg,asf,ogg,flv"
_CONTAINERS = {"format_whitelist": _FORMATS, "protocol_whitelist": "file", "max_pixels": str(LARGEST_PIXELS)}


@dataclass(frozen=True)
class Picture:
    """One frame, upright, sRGB."""

    index: int  # position in a video, or the number in the name of a still image
    time_s: float | None  # presentation time on the video's clock [s]; None if the file states none
    rgb: Pixels  # (H, W, 3) uint8
    damaged: bool = False  # whether packets of it, or of what it was coded from, are missing or wrong


@dataclass(frozen=True)
class VideoFile:
    """A video, and what is chosen of it."""

    path: Path
    stream: int | None = None  # number of the film, from 0, where the file has several
    from_file: bool = False  # whether times count from the start of the file, not from the first picture


def read_video(path: Path | VideoFile, fps: float | None = None) -> Iterator[Picture]:
    """Decodes frame by frame; times are the container's presentation times from the first picture, else of
    `fps`.

    Pictures are upright, with square pixels; those before a cut are returned. After a damaged packet pictures
    are `damaged` up to the next that is coded without others. UserError: not a video, no video stream,
    several without a choice, or pictures larger than 40 megapixels.
    """
    video = path if isinstance(path, VideoFile) else VideoFile(path)
    path = video.path
    with _open_video(path) as container:
        stream = _find_film(container, video)
        # Two cores at most: a bench machine scores several recordings at a time.
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = 2
        has_times, index = container.format.name != "avi", 0
        start_s = (container.start_time or 0) / av.time_base if has_times and video.from_file else None
        damaged = False
        try:
            for frame, ticks, broken in _decode(container, stream):
                width = _square_width(frame.width, stream.sample_aspect_ratio)
                refuse_large(max(width, frame.width), frame.height)
                rgb = frame.to_ndarray(format="rgb24")
                if width != frame.width:
                    rgb = np.asarray(cv2.resize(rgb, (width, frame.height), interpolation=cv2.INTER_AREA))
                stated_s = None if ticks is None else float(ticks * frame.time_base)
                start_s = stated_s if start_s is None and stated_s is not None else start_s
                computed_s = None if fps is None else index / fps
                time_s = computed_s if stated_s is None or start_s is None else stated_s - start_s
                damaged = broken or frame.is_corrupt or (damaged and not frame.key_frame)
                yield Picture(index, time_s, np.ascontiguousarray(_turn_upright(rgb, frame)), damaged)
                index += 1
        except (av.error.FFmpegError, ValueError) as error:
            if index == 0:
                raise UserError(f"{path}: not a readable video ({_reason(error)})") from None
        if index == 0:
            raise UserError(f"{path}: holds no frames")


def _decode(
    container: InputContainer, stream: av.VideoStream
) -> Iterator[tuple[av.VideoFrame, int | None, bool]]:
    """Frames in order of presentation, their times in ticks, and whether a packet before them is
    unreadable."""
    # AVI has one time per packet, in the order of decoding, from which FFmpeg guesses those of presentation.
    packets, broken, count = deque[int](), False, 0
    for packet in container.demux(stream):
        if container.format.name == "avi" and packet.size and packet.dts is not None:
            packets.append(packet.dts)
        try:
            frames = packet.decode()
        except av.error.InvalidDataError:
            if not count:
                raise
            broken = True
            continue
        for frame in frames:
            yield frame, packets.popleft() if packets else frame.pts, broken
            broken, count = False, count + 1


def find_start(path: Path | VideoFile) -> float:
    """Time of a video's first picture from the start of its file [s], which sound or undecodable pictures may
    begin; 0 if its format has no times. UserError: it is no video."""
    video = path if isinstance(path, VideoFile) else VideoFile(path)
    first = next(read_video(replace(video, from_file=True)))
    return first.time_s or 0.0


def find_date(path: Path) -> float | None:
    """When a video says that it was begun [s since 1970]; None if it doesn't. UserError: it is no video."""
    with _open_video(path) as container:
        text = container.metadata.get("creation_time", "")
    return _seconds_since_1970(text)


def _seconds_since_1970(text: str) -> float | None:
    """Of a date such as 2026-11-28T10:02:00.5Z; None: it is none."""
    try:
        moment = np.datetime64(text.strip().removesuffix("Z").replace(" ", "T"), "us")
    except ValueError:
        return None
    return None if np.isnat(moment) else float(moment.astype(np.int64)) / 1e6


def find_length(path: Path | VideoFile) -> float:
    """Length that a video states for its film [s]; 0 if none. UserError: it is no video."""
    video = path if isinstance(path, VideoFile) else VideoFile(path)
    with _open_video(video.path) as container:
        stream = _find_film(container, video)
        return float(stream.duration * stream.time_base) if stream.duration else 0.0


def _find_film(container: InputContainer, video: VideoFile) -> av.VideoStream:
    """The film of a video. UserError: there is none, or several and none is chosen."""
    if not container.streams.video:
        raise UserError(f"{video.path}: holds no video stream")
    films = _list_films(container, video.path)
    number = 0 if video.stream is None and len(films) == 1 else video.stream
    if number is None or not 0 <= number < len(films):
        streams = ", ".join(f"{k}: {film.width} x {film.height}" for k, film in enumerate(films))
        raise UserError(
            f"{video.path}: holds {len(films)} films ({streams}): choose one by stream: in meta.yaml or "
            "bench import --use stream=NUMBER"
        )
    return films[number]


def _list_films(container: InputContainer, path: Path) -> list[av.VideoStream]:
    """The video streams that are no covers: pictures attached, or single ones next to a film."""
    streams = [
        stream for stream in container.streams.video if not stream.disposition & Disposition.attached_pic
    ]
    if len(streams) < 2:
        return streams or [*container.streams.video]
    counts = dict.fromkeys((stream.index for stream in streams), 0)
    with _open_video(path) as reopened:
        for packet in islice(reopened.demux(*reopened.streams.video), _PEEKED):
            if packet.size and packet.stream.index in counts:
                counts[packet.stream.index] += 1
                if min(counts.values()) > 1:
                    break
    return [stream for stream in streams if counts[stream.index] > 1] or streams[:1]


def _turn_upright(rgb: Pixels, frame: av.VideoFrame) -> Pixels:
    """The picture (H, W, 3) as by the frame's display matrix, which turns and mirrors."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return rgb
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    if abs(b) > abs(a):
        rgb, a, d = rgb.swapaxes(0, 1), c, b
    return rgb[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def is_video(path: Path) -> bool:
    """Whether the path is a video by its suffix, or a folder of PNGs without sequences."""
    if path.is_dir():
        return bool(find_stills(path)) and not any(path.glob("*.zarr"))
    return path.suffix.lower() in SUFFIXES


def read_frames(path: Path, fps: float) -> Iterator[Picture]:
    """As `read_video`; the pictures of a folder by the numbers in their names, at `fps`."""
    if not path.is_dir():
        return read_video(path, fps)
    stills = number_files(find_stills(path))
    times = still_times(stills, fps, [])
    return (replace(picture, time_s=times[picture.index]) for picture in read_pictures(stills))


def count_frames(path: Path | VideoFile) -> int | None:
    """Number of frames stated by the container, else counted; None: no video stream. May raise UserError."""
    video = path if isinstance(path, VideoFile) else VideoFile(path)
    with _open_video(video.path) as container:
        if not container.streams.video:
            return None
        stream = _find_film(container, video)
        count = stream.frames
        with suppress(av.error.FFmpegError):  # those before a cut
            if not count:
                for packet in container.demux(stream):
                    count += packet.size > 0
        return count or None


def pixel_aspect(path: Path | VideoFile) -> float:
    """Width over height of a video's pixels, 1 if not stated. UserError if it is not a video."""
    video = path if isinstance(path, VideoFile) else VideoFile(path)
    with _open_video(video.path) as container:
        if not container.streams.video:
            return 1.0
        return _square_width(1 << 20, _find_film(container, video).sample_aspect_ratio) / (1 << 20)


def _square_width(width: int, aspect: Fraction | None) -> int:
    """Width in square pixels of a picture with `width` pixels of that aspect ratio."""
    ratio = float(aspect) if aspect else 1.0
    return round(width * ratio) if 1 / _WIDEST <= ratio <= _WIDEST else width


def _open_video(path: Path) -> InputContainer:
    checked_file.check_file(path, _LARGEST_BYTES)
    _refuse_other(path)
    try:
        # With "file:" a colon in the path is not taken for a protocol.
        container: InputContainer = av.open(f"file:{path}", options=_CONTAINERS)
        for stream in container.streams.video:
            refuse_large(stream.width, stream.height)
        return container
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise UserError(f"{path}: not a readable video ({_reason(error)})") from None


def _refuse_other(path: Path) -> None:
    """Raises UserError for a file that is no video by its first bytes, or one whose index is missing."""
    with checked_file.open_file(path, _LARGEST_BYTES) as file:
        head = file.read(512)
        if not head.strip(b"\0"):
            what = "is empty" if not head else "begins with zeros: it was not copied or downloaded to its end"
            raise UserError(f"{path}: {what}")
        if head.startswith(b"version https://git-lfs"):
            raise UserError(f"{path}: a pointer of Git LFS, not the video: git lfs pull fetches it")
        if head.lstrip()[:9].lower() in (b"<!doctype", b"<html>\n<h") or head.lstrip().lower().startswith(
            b"<html"
        ):
            raise UserError(f"{path}: a web page, not the video: download it again")
        if head.startswith((b"/annex/", b".git/annex/", b"../.git/annex/")):
            raise UserError(f"{path}: a pointer of git-annex, not the video: git annex get fetches it")
        if head[4:8] == b"ftyp" and not _has_index(file):
            raise UserError(
                f"{path}: an MP4 without its index (moov), as after a recorder's power failure or "
                "an unfinished "
                "copy: copy it again, or repair it with a whole video of the same camera (untrunc)"
            )


def _has_index(file: BufferedReader) -> bool:
    """Whether an MP4's boxes, of [ISO 14496-12, 4.2], include moov."""
    size, position = os.fstat(file.fileno()).st_size, 0
    while position + 8 <= size:
        file.seek(position)
        length, name = struct.unpack(">I4s", file.read(8))
        if name == b"moov":
            return True
        if length == 1:
            length = struct.unpack(">Q", file.read(8).rjust(8, b"\0"))[0]
        position += length if length >= 8 else size
    return False


def read_pictures(paths: Mapping[int, Path]) -> Iterator[Picture]:
    """Still images by number, without times; 16 bits reduced to the 8 in use. UserError: sizes differ."""
    size, bits = None, None
    for index, path in paths.items():
        stored = _read_colours(path)
        if bits is None and stored.dtype == np.uint16:
            bits = count_bits(map(_read_colours, paths.values()))
        rgb = np.ascontiguousarray(as_8_bits(stored, bits or 16)[..., ::-1])
        size = size or rgb.shape[:2]
        _refuse_other_size(path, rgb.shape[:2], size, "the frames before are")
        yield Picture(index, None, rgb)


def read_picture(path: Path) -> Pixels:
    """One still image as (H, W, 3) uint8 sRGB. Raises as `read_pictures`."""
    return next(read_pictures({0: path})).rgb


def _read_colours(path: Path) -> Array:
    return checked_file.read_picture(path, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)


def count_bits(pictures: Iterable[Array]) -> int:
    """Bits that 16-bit pictures use, at least 8: cameras of 10 to 14 bits leave the upper ones empty."""
    return max(8, max(int(picture.max()) for picture in pictures).bit_length())


def as_8_bits(picture: Array, bits: int) -> Array:
    """A picture of 16 bits, of which so many are used, reduced to uint8; others as they are."""
    if picture.dtype.kind != "u" or picture.dtype.itemsize != 2:
        return picture
    return np.asarray(np.minimum(picture >> (bits - 8), 255), np.uint8)


def read_mask(path: Path, size: tuple[int, int]) -> Mask:
    """The mask (H, W) of a picture: above half of its maximum, or not 0 if it holds class numbers.

    Of one colour, its opacity. UserError: unreadable, or not of `size` (height, width).
    """
    picture = checked_file.read_picture(path, cv2.IMREAD_UNCHANGED)
    levels = np.atleast_3d(picture)
    if levels.shape[2] == 4:
        colour, opacity = levels[..., :3], levels[..., 3]
        colours = colour[opacity > 0]
        single_colour = np.ptp(opacity) > 0 and (colours == colours[:1]).all()
        levels = opacity[..., None] if single_colour else colour * (opacity > 0)[..., None]
    brightest = levels.max(axis=2)
    is_labels = np.count_nonzero(np.bincount(brightest.ravel())) <= _LABELS
    mask = brightest > (0 if is_labels else brightest.max() / 2)
    _refuse_other_size(path, mask.shape, size, "the video is")
    return np.asarray(mask, bool)


def _refuse_other_size(path: Path, shape: tuple[int, ...], size: tuple[int, ...], other: str) -> None:
    if shape != size:
        raise UserError(f"{path}: is {shape[1]} x {shape[0]}, but {other} {size[1]} x {size[0]}")


def shrink_picture(picture: NDArray[A], shrink: int) -> NDArray[A]:
    """Downsamples an array (H, W[, C]) by `shrink`; a remainder at the right and bottom is cropped."""
    if shrink == 1:
        return picture
    size = (max(1, picture.shape[1] // shrink), max(1, picture.shape[0] // shrink))
    # Cropped to a multiple, so that a pixel of the small picture is shrink x shrink pixels of the large one.
    cropped = picture[: size[1] * shrink, : size[0] * shrink]
    return np.asarray(cv2.resize(cropped, size, interpolation=cv2.INTER_AREA), picture.dtype)


def shrink_mask(mask: Mask, shrink: int, above: int) -> Mask:
    """Downsamples a mask (H, W); True where more than `above` / 255 of a pixel is True."""
    return np.asarray(shrink_picture(mask.astype(np.uint8) * 255, shrink) > above)


def _reason(error: Exception) -> str:
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return text.split("]")[-1].split(":")[0].strip() or type(error).__name__
