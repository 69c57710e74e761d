"""`bench import`: recordings of other systems, converted into recording folders."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Literal

import numpy as np

from bench.importers import file_kinds
from bench.importers.import_formats import BAG, IMPORTERS, PLAIN
from bench.recording import clocks, recording_writer
from bench.recording.sensor_table import find_bias
from synth.arrays import Array, Floats, Ints, Pixels
from synth.errors import UserError, first_line
from synth.flow.stereo.calibration import read_rig
from synth.system import camera_file, checked_file
from synth.system.checked_file import refuse_large
from synth.video import read_video as video
from synth.video import stereo_layout
from synth.video.file_numbers import STILLS, find_stills

ROLES = ("frames", "frame_time", "force", "force_time")  # parts of a source; `--use ROLE=NAME` names one
PLAIN_ROLES = (
    *("frames", "frame_time", "force", "fps", "right", "calibration"),
    *("columns", "stream", "start"),
)
"""Of loose files: `fps` is the rate of pictures without times; `frames` and `right` may be patterns.
`columns` names the columns of the table of forces in order, `-` for others; `stream` is the number of a
film in a video with several; `start=file` counts a video's times from the start of its file, as sound may,
not from its first picture."""
BAG_ROLES = ("frames", "force", "right", "depth", "calibration", "right_calibration")  # topics
_LEAST_PX = 8
_LATEST_S = 1e11
_LONGEST_STEP_S = 10.0

LARGEST_BYTES = 1 << 42  # of a file
MOST_FRAMES = 10_000_000  # of a source, and samples of a sensor


@dataclass(frozen=True)
class SecondView:
    """Pictures of the right camera or the depth camera, not yet decoded."""

    kind: Literal["right", "depth"]
    frame: Ints  # (M,) number of the frame that belongs to each picture; -1: none
    pictures: Callable[[], Iterator[Array]]
    """The pictures in order: RGB (H, W, 3) uint8, or depth (H, W) mm, uint16 or float32; 0, NaN: unknown."""
    lens: Mapping[str, object] | None = None  # section `depth` of meta.yaml; None: unknown, or stereo
    pair: Mapping[str, Floats] | None = None
    """OpenCV's K1, D1, K2, D2, R, T [mm] of the stereo pair; None: unknown, or a depth camera."""


@dataclass(frozen=True)
class Intake:
    """The contents of a source; its pictures are not yet decoded."""

    times_s: Floats  # (T,) of the frames [s]
    pictures: Callable[[], Iterator[Array]]
    """The T frames in order: grey (H, W) or RGB[A] (H, W, C) uint8 or uint16; after `read_source`
    (H, W, 3) uint8."""
    force_s: Floats = field(default_factory=lambda: np.zeros(0))  # (N,) s; empty: no force
    force: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (N, 3) in N, or the source's own unit
    notes: tuple[str, ...] = ()
    second: SecondView | None = None
    axes: str = "xyz"
    """The axes of force that the source has; empty: a size, in the first component."""
    in_newtons: bool = False  # whether the source states the unit of its force
    film: Path | None = None  # a video of exactly these pictures, which is copied as it is
    poses: Mapping[str, Floats] = field(default_factory=dict)
    """Poses (T, 4, 4) of instruments by name, in the source's axes and unit; NaN: unknown."""


def read_source(source: Path, use: Mapping[str, str] | None = None, layout: str | None = None) -> Intake:
    """Opens a source.

    `use`: role → name in the source, where the choice is ambiguous. `layout`: of two cameras in its pictures,
    as of `stereo_layout.LAYOUTS`, with `,right-first` if so. UserError for an unknown format, a library that
    is not installed, no usable contents, or an ambiguous choice.
    """
    use = dict(use or {})
    if not source.is_dir():
        checked_file.check_file(source, LARGEST_BYTES)
    ending = source.suffix.lower()[1:]
    if source.is_dir():
        ending = _folder_ending(source)
    if ending not in IMPORTERS.names():
        raise file_kinds.explain_unknown(source, sorted(f".{name}" for name in IMPORTERS.names()))
    reader = IMPORTERS.builtin.get(ending, "")
    is_bag = reader == BAG
    roles = {BAG: BAG_ROLES, PLAIN: PLAIN_ROLES}.get(reader, (*ROLES, "calibration"))
    if unknown_roles := sorted(set(use) - set(roles)):
        raise UserError(f"--use {unknown_roles[0]}=...: {source.name} has only {', '.join(roles)}")
    calibration = None if is_bag else use.pop("calibration", None)
    with _damage_as_user_error(source):
        intake: Intake = IMPORTERS.load_as_is(ending)(source, use)
        if not isinstance(intake, Intake):
            raise TypeError(f"{IMPORTERS.label(ending)} returned {type(intake).__name__}, expected Intake")
        _refuse_odd(source, intake)
        right = intake.second.pictures() if intake.second and intake.second.kind == "right" else ()
        bits, notes = 16, list(intake.notes)
        if (picture := next(intake.pictures())).dtype.kind == "u" and picture.itemsize == 2:
            bits = video.count_bits(chain(intake.pictures(), right))
            notes.append(f"the pictures use {bits} of 16 bits, which are reduced to 8")

    def decode(view: Intake | SecondView, rgb: bool = True) -> Iterator[Array]:
        with _damage_as_user_error(source):
            size = None
            for k, picture in enumerate(view.pictures()):
                picture = _as_rgb(picture, bits) if rgb else picture
                if picture.shape != (size := size or picture.shape):
                    raise UserError(f"{source}: frame {k} has another size than the frames before it")
                yield picture

    second = intake.second
    if second is not None:
        second = replace(second, pictures=partial(decode, second, second.kind == "right"))
    intake = replace(intake, pictures=partial(decode, intake), second=second)
    notes += _describe_force(intake)
    if layout is not None:
        intake = _split(intake, layout)
    elif second is None and (
        guess := stereo_layout.find_layout([*islice(intake.pictures(), stereo_layout.PICTURES)])
    ):
        cure = f"the pictures seem to be of two cameras: import again with --stereo-layout {guess}"
        notes.append(stereo_layout.MIXED.get(guess, cure))
    if calibration is not None:
        intake = _add_calibration(intake, Path(calibration))
        notes += camera_file.describe(Path(calibration))
    if intake.second is not None and not is_bag and intake.second.pair is None:
        notes.append("no calibration of the pair: add stereo to meta.yaml, or --use calibration=FILE")
    return replace(intake, notes=tuple(notes))


def _folder_ending(source: Path) -> str:
    """The reader of a folder: of a ROS 2 bag, or of pictures or videos; None: a recording, or neither."""
    names = [path.suffix.lower() for path in source.glob("*") if not path.name.startswith(".")]
    if (source / "metadata.yaml").is_file() or any(suffix in (".mcap", ".db3") for suffix in names):
        return "bag"
    is_recording = (source / "meta.yaml").is_file()
    has_pictures = find_stills(source, STILLS) or any(suffix in video.SUFFIXES for suffix in names)
    return "npy" if has_pictures and not is_recording else ""


def _add_calibration(intake: Intake, file: Path) -> Intake:
    """The source with the calibration of its two cameras. UserError: there is one, or the file is of none."""
    if intake.second is None:
        raise UserError("--use calibration=...: requires right=... or --stereo-layout")
    height, width = next(intake.pictures()).shape[:2]
    rig = read_rig(file, (width, height))
    pair = {"K1": rig.left.K, "D1": rig.left.distortion, "K2": rig.right.K, "D2": rig.right.distortion}
    pair |= {"R": rig.rotation, "T": rig.translation[:, None]}
    return replace(intake, second=replace(intake.second, pair=pair))


def _split(intake: Intake, layout: str) -> Intake:
    """Two cameras' pictures that are in one, or follow each other. UserError for no such layout."""
    name, _, order = layout.partition(",")
    if name in stereo_layout.MIXED:
        raise UserError(f"--stereo-layout {layout}: {stereo_layout.MIXED[name]}")
    if intake.second is not None or name not in stereo_layout.LAYOUTS or order not in ("", "right-first"):
        known = ", ".join(stereo_layout.LAYOUTS)
        why = f"one of {known}, or with ,right-first" if intake.second is None else "it has a right camera"
        raise UserError(f"--stereo-layout {layout}: {why}")
    in_turn, left = name == "alternating", int(bool(order))
    count = len(intake.times_s) // 2 if in_turn else len(intake.times_s)

    def view(side: int) -> Iterator[Array]:
        if in_turn:
            return islice(intake.pictures(), side, 2 * count, 2)
        return (stereo_layout.split(picture, name)[side] for picture in intake.pictures())

    times = intake.times_s[left : 2 * count : 2] if in_turn else intake.times_s
    second = SecondView("right", np.arange(count), partial(view, 1 - left))
    poses = {name: rows[left : 2 * count : 2] if in_turn else rows for name, rows in intake.poses.items()}
    return replace(intake, times_s=times, pictures=partial(view, left), second=second, film=None, poses=poses)


@contextmanager
def _damage_as_user_error(source: Path) -> Iterator[None]:
    """Turns what libraries raise over a damaged file, which may be any exception, into one line."""
    try:
        yield
    except (UserError, KeyboardInterrupt, GeneratorExit):
        raise
    except ImportError as error:
        raise UserError(f"{source}: needs {error.name}: pip install '.[readers]' in the clone") from None
    except Exception as error:
        raise file_kinds.explain_unreadable(source, first_line(error)) from error


def _refuse_odd(source: Path, intake: Intake) -> None:
    """Raises UserError for times that are not seconds, or not as many as the forces."""
    if len(intake.times_s) == 0:
        raise UserError(f"{source}: holds no frames")
    for clock, times in (("frame", intake.times_s), ("force", intake.force_s)):
        step = float(np.median(np.abs(np.diff(times)))) if len(times) > 1 else 0.0
        if not (np.abs(times) < _LATEST_S).all() or step >= _LONGEST_STEP_S:
            raise UserError(f"{source}: {clock} times are {step:g} s apart: are they in seconds?")
    if len(intake.force_s) != len(intake.force):
        raise UserError(f"{source}: {len(intake.force)} forces, {len(intake.force_s)} times for them")
    if other := clocks.find_other_unit(intake.times_s, intake.force_s):
        raise UserError(f"{source}: {other}")


def _describe_force(intake: Intake) -> list[str]:
    """Notes on what the force needs: its bias, and a clock that isn't that of the pictures."""
    if not len(intake.force):
        return []
    notes = [bias] if (bias := find_bias(intake.force)) else []
    sensor_s, frame_s = intake.force_s[np.isfinite(intake.force_s)], intake.times_s
    if len(sensor_s) and (sensor_s.min() > frame_s.max() or sensor_s.max() < frame_s.min()):
        notes.append(
            f"the sensor's clock ({sensor_s.min():.10g} to {sensor_s.max():.10g} s) isn't that of "
            "the pictures "
            f"({frame_s.min():.10g} to {frame_s.max():.10g} s): nothing is scored before sync is "
            "set in meta.yaml; "
            f"if both start together: method: offset, offset_s: {frame_s.min() - sensor_s.min():.6f}"
        )
    return notes


def write_recording(
    intake: Intake,
    out: Path,
    newtons: float | None,
    about: Mapping[str, object],
    progress: Callable[[int], None],
) -> Path:
    """Writes a recording folder, whole or not at all: lossless video.mp4, frames.csv, force.csv, meta.yaml.

    A right camera adds right/ and stereo.yaml, a depth camera depth/, poses poses.csv. `newtons`: per unit of
    force in the source, None: the source's, or 1; `about`: contents of meta.yaml; `progress`: called with the
    number of frames written. Raises UserError if the folder exists, a picture can't be decoded, or the source
    states another unit.
    """
    if newtons not in (None, 1.0) and intake.in_newtons and len(intake.force):
        raise UserError(
            f"--newtons {newtons:g}: the source states its unit, and its forces are newtons "
            "already: leave it out, "
            "or name the columns without a unit by --use columns="
        )
    with checked_file.folder_of(out) as part:
        # The container requires rising times; frames.csv has the true ones.
        steps = np.maximum(np.diff(intake.times_s), 1e-3)
        rising = intake.times_s[0] + np.cumsum([0.0, *steps])
        if intake.film is not None:
            shutil.copyfile(intake.film, part / f"video{intake.film.suffix.lower()}")
            progress(len(intake.times_s))
        else:
            recording_writer.write_video(
                part / "video.mp4", intake.pictures(), rising, crf=0, progress=progress
            )
        recording_writer.write_frames(part, intake.times_s)
        if len(intake.force):
            recording_writer.write_force(part, intake.force_s, (newtons or 1.0) * intake.force, intake.axes)
        if intake.poses:
            recording_writer.write_poses(part, intake.times_s, intake.poses)
        about = dict(about)
        if (second := intake.second) is not None:
            recording_writer.write_second(part / second.kind, second.frame.tolist(), second.pictures())
            if second.pair is not None:
                recording_writer.write_storage(part / "stereo.yaml", second.pair)
                about["stereo"] = {"calibration": "stereo.yaml"}
            if second.lens is not None:
                about["depth"] = dict(second.lens)
        recording_writer.write_meta(part, about)
    return out


def choose_name(
    role: str, wanted: str | None, names: list[str], noun: str, others: Mapping[str, str] | None = None
) -> str | None:
    """The name for a role: the requested one, else the only one, else None. UserError if it is missing, or
    there are several and none is requested. `others`: kinds of what is there but can't be it, by name."""
    if wanted is not None:
        if wanted not in names:
            kinds = ", ".join([*names, *(f"{name} ({kind})" for name, kind in (others or {}).items())])
            if wanted in (others or {}):
                raise UserError(
                    f"--use {role}={wanted}: is {(others or {})[wanted]}, no {role}; there are {kinds}"
                )
            raise UserError(f"--use {role}={wanted}: no such {noun}; there are {kinds or 'none'}")
        return wanted
    if len(names) > 1:
        raise UserError(f"several {noun}s could be the {role}: add --use {role}=NAME; {', '.join(names)}")
    return names[0] if names else None


def _as_rgb(picture: Array, bits: int) -> Pixels:
    """Grey or colour, of 8 bits or so many of 16, as (H, W, 3) uint8 sRGB. UserError for other types."""
    picture = video.as_8_bits(picture, bits)
    if picture.ndim == 2 or picture.shape[2] == 1:
        picture = np.repeat(picture.reshape(*picture.shape[:2], 1), 3, axis=2)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] not in (3, 4):
        kind = f"{picture.shape} {picture.dtype}"
        raise UserError(f"pictures of {kind}: expected 1, 3 or 4 channels of 8 or 16 bits")
    height, width = picture.shape[:2]
    if min(height, width) < _LEAST_PX:
        raise UserError(f"pictures of {width} x {height} px: each side must have at least {_LEAST_PX} px")
    refuse_large(width, height)
    return np.ascontiguousarray(picture[..., :3])
