"""The track of a video: the motion of the tissue in every frame, without that of the camera and the pulse.

    with track_video(footage, settings) as track:
        for frame in track.frames():
            ...

A video is decoded and its flow computed once. Heart and breath are known when all of it has been tracked;
they are subtracted when frames are read from the track, which is kept on disk meanwhile. Only where tissue
fills the picture and the camera moves, pictures have to be aligned before flow: then it is computed again.

`learn predict`, `bench score` and `bench check` are this driver; `bench live` is a single `VideoPass`.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numcodecs import BitRound, Blosc

from synth.arrays import Array, Mask
from synth.errors import UserError
from synth.flow.lookalike import LookalikeSearch
from synth.flow.recording.decode import Decoder, Footage, RecordingFlowSettings
from synth.flow.recording.detrend import Detrend
from synth.flow.recording.find_pulse import PulseEstimate, PulseSearch
from synth.flow.recording.find_tissue import TissueSearch, choose_frames
from synth.flow.recording.finding import Finding, first_fault
from synth.flow.recording.flow import LocalFlow
from synth.flow.recording.frame_motion import FrameMotion, Size
from synth.flow.recording.harmonic_fit import Span
from synth.flow.recording.right_pictures import RightPictures
from synth.flow.recording.video_pass import VideoPass
from synth.flow.stereo.stereo_track import Motion3D
from synth.system.stopwatch import Stopwatch

_KEPT_BITS = 12
"""Of the mantissa: a motion is kept to 1.2e-4 of itself, which its noise exceeds a hundred times."""
_ROUNDED = ("flow", "confidence")
_FLAGS = ("masked", "tool")


class FrameFile:
    """Frames on disk, in a temporary file without a name: read in order, any number of times."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._finalizer = weakref.finalize(self, self._file.close)
        self._pack, self._round = Blosc(cname="lz4", shuffle=Blosc.BITSHUFFLE), BitRound(_KEPT_BITS)
        self._frames: list[tuple[FrameMotion, list[tuple[str, int, int, str, tuple[int, ...]]]]] = []
        self.bytes = 0

    def add(self, frame: FrameMotion) -> None:
        """Appends a frame; of a right camera only the motion is kept. UserError: the disk is full."""
        arrays: dict[str, Array] = {name: self._round_bits(getattr(frame, name)) for name in _ROUNDED}
        if frame.motion is not None:
            planes = frame.motion.motion, frame.motion.deviation
            arrays |= dict(zip(("motion", "deviation"), map(self._round_bits, planes), strict=True))
        arrays |= {name: getattr(frame, name) for name in _FLAGS if getattr(frame, name) is not None}
        arrays["rgb"] = frame.rgb
        entries = [
            (name, *self._write(array), array.dtype.str, array.shape) for name, array in arrays.items()
        ]
        empty = np.zeros((0, 0), np.float32)
        record = replace(frame, flow=empty, confidence=empty, motion=None, masked=None, tool=None, right=None)
        self._frames.append((replace(record, rgb=np.zeros((0, 0, 3), np.uint8)), entries))

    def read(self) -> Iterator[FrameMotion]:
        """The frames in order."""
        for record, entries in self._frames:
            arrays = {
                name: self._read(start, size, kind, shape) for name, start, size, kind, shape in entries
            }
            planes = [arrays.pop(name) for name in ("motion", "deviation") if name in arrays]
            fields: dict[str, Any] = {**arrays, "motion": Motion3D(*planes) if planes else None}
            yield replace(record, **fields)

    def close(self) -> None:
        """Gives the disk's space back, as the end of this object does."""
        self._finalizer()

    def _round_bits(self, values: Array) -> Array:
        floats = np.ascontiguousarray(values, np.float32)
        return np.asarray(self._round.encode(floats)).view(np.float32).reshape(values.shape)

    def _write(self, array: Array) -> tuple[int, int]:
        data, start = self._pack.encode(np.ascontiguousarray(array)), self.bytes
        try:
            self._file.seek(start)
            self._file.write(data)
        except OSError as error:
            folder = tempfile.gettempdir()
            raise UserError(
                f"{folder}: the motion of the video can't be kept there ({error.strerror}): free some space, "
                "or set TMPDIR to another folder"
            ) from error
        self.bytes += len(data)
        return start, len(data)

    def _read(self, start: int, size: int, kind: str, shape: tuple[int, ...]) -> Array:
        self._file.seek(start)
        return np.frombuffer(self._pack.decode(self._file.read(size)), kind).reshape(shape)


@dataclass(frozen=True, eq=False)
class VideoTrack:
    """A tracked video."""

    video: VideoPass
    """Rest frame, findings and summary; of the second pass if there were two."""
    search: PulseSearch | None
    """Search for heart and breath; None: not requested."""
    frame_file: FrameFile
    pair: RightPictures | None
    """Comparison of the pictures of both cameras; None: not requested."""

    @property
    def removed(self) -> PulseEstimate | None:
        """Pulsation that is subtracted from every frame; None: none."""
        return None if self.search is None else self.search.pulse

    @property
    def notes(self) -> list[str]:
        """Sentences on the processing for reports."""
        missed = "" if self.search is None or first_fault(self.video.findings) else self.search.describe()
        return self.video.notes + ([missed] if missed else [])

    def frames(self) -> Iterator[FrameMotion]:
        """The tracked frames without pulsation, the rest frame first; without the right camera's pictures."""
        if self.removed is None:
            return self.frame_file.read()
        return map(Detrend(self.removed, self.video.mm_per_px).process, self.frame_file.read())

    def __enter__(self) -> VideoTrack:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.frame_file.close()


def track_video(
    footage: Footage,
    settings: RecordingFlowSettings,
    free_s: Sequence[Span] = (),
    *,
    flow: LocalFlow | None = None,
    watch: Stopwatch | None = None,
    progress: Callable[[int], None] = lambda done: None,
    compare_cameras: bool = False,
) -> VideoTrack:
    """Tracks a video from its rest frame on.

    Tissue that is not given is found before, in a few frames. `free_s`: spans known to be without contact
    [s]; `compare_cameras`: whether the pictures of a right camera are compared with the left ones. Other
    arguments and errors as for `VideoPass`.
    """
    flow, watch = flow or LocalFlow(), watch or Stopwatch()
    if footage.tool is None and footage.lookalikes is None and settings.masks != "none":
        footage = _with_lookalikes(footage, settings, watch)
    if footage.tissue is None:
        footage = _with_tissue(footage, settings, watch)
    first = VideoPass(footage, settings, flow=flow, watch=watch, progress=progress)
    frame_file, pair = _store_frames(first, compare_cameras)
    search = first.search(free_s)
    if search is None or search.camera is None:
        return VideoTrack(first, search, frame_file, pair)
    frame_file.close()
    second = VideoPass(footage, settings, search.camera, flow=flow, watch=watch, progress=progress)
    return VideoTrack(second, search, *_store_frames(second, compare_cameras))


def _store_frames(video: VideoPass, compare_cameras: bool) -> tuple[FrameFile, RightPictures | None]:
    frame_file, pair = FrameFile(), RightPictures(video) if compare_cameras else None
    for frame in video.frames():
        if pair is not None:  # here: the right camera's pictures aren't kept
            pair.add(frame)
        with video.watch.stage("store"):
            frame_file.add(frame)
    return frame_file, pair


def _with_lookalikes(footage: Footage, settings: RecordingFlowSettings, watch: Stopwatch) -> Footage:
    """The footage with the tissue that looks like an instrument in its rest frame, by a few of its frames."""
    bare, plain = replace(footage, depth=None), replace(settings, rate_hz=None)
    decoder = Decoder(bare, plain, watch, lambda done: None)
    search = LookalikeSearch(decoder.rest.rgb, decoder.rest.tissue)
    if decoder.rest.fault or not search.regions:
        return footage
    with watch.stage("decode"):
        excerpt = replace(bare, only=choose_frames(bare))
    decoder = Decoder(excerpt, plain, watch, lambda done: None)
    with watch.stage("mask"):
        for number, picture in enumerate(decoder.frames()):
            if number % 2 == 0:
                search.add(decoder.process(picture).rgb)
        return replace(footage, lookalikes=search.find())


def _with_tissue(footage: Footage, settings: RecordingFlowSettings, watch: Stopwatch) -> Footage:
    """The footage with the tissue that is found in a few of its frames."""
    result = find_tissue(footage, settings, watch)
    if result is None:
        return footage
    mask, finding = result

    def tissue(size: Size) -> Mask:
        resized = cv2.resize(mask.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST)
        return np.asarray(resized > 0)

    return replace(footage, tissue=tissue, findings=(finding,))


def find_tissue(
    footage: Footage, settings: RecordingFlowSettings, watch: Stopwatch | None = None
) -> tuple[Mask, Finding] | None:
    """The tissue in the rest frame (h, w), downsampled, and how sure it is, by flow in this process of a few
    frames; None if there is nothing to track. UserError: unreadable video."""
    watch = watch or Stopwatch()
    with watch.stage("decode"):
        excerpt = replace(footage, only=choose_frames(footage), depth=None)
    video = VideoPass(excerpt, replace(settings, shrink=0, rate_hz=None, pulse=False), watch=watch)
    if video.rest.fault:
        return None
    search = TissueSearch(video.rest)
    for frame in video.frames():
        search.add(frame)
    with watch.stage("mask"):
        return search.find()
