"""`meta.yaml`: properties of a recording that are not in the video or the sensor's file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, model_validator

from synth.errors import UserError
from synth.job.job_writer import section_lines
from synth.job.types import MembraneState, PronyTerms, Section
from synth.system import checked_file
from synth.system.config_file import ConfigFile, Mistake


def _must_not_vanish(value: float) -> float:
    if value == 0:
        raise ValueError("0 is no exponent of Ogden's law")
    return value


Share = Annotated[FiniteFloat, Field(ge=0, lt=1)]
Positive = Annotated[FiniteFloat, Field(ge=1e-6, le=1e6)]
Number = Annotated[FiniteFloat, Field(ge=-1e10, le=1e10)]  # also times since 1970
Point = tuple[Number, Number]
OgdenExponent = Annotated[FiniteFloat, Field(ge=-40, le=40), AfterValidator(_must_not_vanish)]
PoissonsRatio = Annotated[FiniteFloat, Field(ge=0, lt=0.5)]
Corners = Annotated[int, Field(ge=2, le=1000)]
Row = tuple[Number, Number, Number]
Row4 = tuple[Number, Number, Number, Number]


def _must_run_forward(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] >= span[1]:
        raise ValueError("a span must end after it starts")
    return span


def _must_not_fall(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError("give the lower end first")
    return span


Span = Annotated[Point, AfterValidator(_must_run_forward)]
LEAST_INTERVALS, LEAST_TURNING = 20, 20
"""Least frame intervals in `sync.calibration_s` to align the clocks, least frames in `sensor.turn_s`."""


class ScaleCalibration(Section):
    """Ways to find the scale if it isn't stated. Give exactly one of them."""

    focal_px: Positive | None = None
    """Focal length [px]; with `distance_mm`."""
    distance_mm: Positive | None = None
    """Distance from the lens to the tissue [mm]; with `focal_px`."""
    bar_px: tuple[Point, Point] | None = None
    """Ends of a scale bar, edges of an instrument of known width, or the tool's tip before and after a known
    move parallel to the tissue plane, as (x, y) [px]."""
    bar_mm: Positive | None = None
    """Length of the bar or the move, or width of the instrument [mm]."""
    checkerboard: Path | None = None
    """Picture of a checkerboard in the tissue plane, in the recording's folder."""
    corners: tuple[Corners, Corners] | None = None
    """Inner corners of the board: columns, rows."""
    square_mm: Positive | None = None
    """Side of one of its squares [mm]."""

    @model_validator(mode="after")
    def _exactly_one_way(self) -> ScaleCalibration:
        options = (
            (self.focal_px, self.distance_mm),
            (self.bar_px, self.bar_mm),
            (self.checkerboard, self.corners, self.square_mm),
        )
        given_options = [option for option in options if any(part is not None for part in option)]
        if len(given_options) != 1 or any(part is None for part in given_options[0]):
            raise ValueError(
                "give one whole way: focal_px + distance_mm, bar_px + bar_mm, or "
                "checkerboard + corners + square_mm"
            )
        return self


class SensorMeta(Section):
    """The force sensor and the processing of its samples."""

    axes: Literal["camera", "sensor"] = "sensor"
    """`camera`: fx, fy, fz are along the camera's x (right), y (down), z (away), and components are scored
    too. `sensor`: only the magnitude is scored."""
    to_camera: tuple[Row, Row, Row] | None = None
    """Rows of the rotation from the sensor's axes to the camera's; with it components are scored too."""
    turn_s: Span | None = None
    """Span of video time in which the tool pulls and pushes in many directions [s], to find that rotation; it
    is not scored."""
    acts_on: Literal["tissue", "tool"] = "tissue"
    """On what the recorded force acts; the sign of a force on the tool is reversed."""
    low_pass_hz: Positive | None = 10.0
    """Cut-off of the sensor's low-pass filter (zero-phase, 4th-order Butterworth) [Hz]; null: no filter."""
    free_s: tuple[Span, ...] = ()
    """Spans without contact, (from, to) on the sensor's clock [s], for tare, drift and noise floor."""
    drift: Literal["keep", "remove"] = "keep"
    """`remove`: the drift of the sensor's zero is removed, linearly between the spans in which the video
    shows the tissue at rest, and its size reported. `keep`: it is only reported."""
    mass_g: Annotated[FiniteFloat, Field(ge=0, le=1e6)] = 0.0
    """Mass on the tool's side of a tool-mounted sensor [g], to remove its weight; needs columns gx, gy, gz in
    force.csv: the unit vector along gravity in the sensor's axes."""

    @model_validator(mode="after")
    def _has_one_rotation(self) -> SensorMeta:
        if self.to_camera is not None:
            rows = np.array(self.to_camera)
            if not np.allclose(rows @ rows.T, np.eye(3), atol=0.02) or np.linalg.det(rows) < 0:
                raise ValueError("to_camera must be a rotation: three orthogonal unit rows")
        if self.turn_s is not None and self.in_camera_axes:
            raise ValueError("give turn_s or to_camera or axes: camera, not several of them")
        return self

    def size_only(self) -> SensorMeta:
        """The same for a sensor of one axis or of a size, whose components can't be compared."""
        return self.model_copy(update={"axes": "sensor", "to_camera": None, "turn_s": None})

    @property
    def in_camera_axes(self) -> bool:
        """Whether force components are along the camera's axes, as recorded or after the rotation."""
        return self.axes == "camera" or self.to_camera is not None


class Sync(Section):
    """Synchronisation of the sensor's clock with the video's."""

    method: Literal["clock", "offset", "correlate"] = "clock"
    """`clock`: both files have the same clock. `offset`: `offset_s` is known, e.g. from a trigger.
    `correlate`: the offset is found on `calibration_s` by correlating force and motion."""
    offset_s: Number = 0.0
    """Added to the sensor's times to give video times [s]."""
    rate: Annotated[FiniteFloat, Field(ge=0.01, le=100)] = 1.0
    """Seconds of video time per second of the sensor's clock, where the video is stamped with another rate
    than it was taken at: 25/30, 0.8333, if 25 pictures a second are stamped as 30. The sensor's times are
    multiplied by it before `offset_s` is added."""
    calibration_s: Span | None = None
    """Span of video time that `correlate` uses [s]; it is not scored."""
    search_s: Positive = 0.5
    """Largest offset that is tried, in both directions [s]."""


class PulseMeta(Section):
    """Removal of heartbeat and breathing from the tissue's motion before force is estimated."""

    remove: bool = True
    """Whether they are removed."""
    free_s: tuple[Span, ...] = ()
    """Spans of video time without contact, (from, to) [s], for finding them; without, the whole video."""


class Stereo(Section):
    """The right camera's `right.mp4` or `right/`."""

    calibration: Path
    """Stereo calibration of OpenCV (K1, D1, K2, D2, R, T), Kalibr or others, in the recording's folder; for
    pictures of the recording's size, or rescaled to it if it states its own."""
    mm_per_unit: Positive = 1.0
    """Millimetres per unit of T, e.g. the side of a chessboard's square."""


class Depth(Section):
    """The depth pictures in `depth/`, registered to the video's pixels."""

    focal_px: Positive
    """Focal length of the video [px]."""
    centre_px: Point | None = None
    """Principal point (x, y) [px]; default: the centre of the picture."""
    mm_per_unit: Positive = 1.0
    """Millimetres per unit of the pictures: 1 for the 16-bit PNG of most depth cameras."""


class Tips(Section):
    """Poses of instruments in `poses.csv`, by which they are looked for in the pictures."""

    projection: tuple[Row4, Row4, Row4]
    """Rows of the 3 x 4 matrix from a point in the tracker's axes to the picture [px]: K [R | t] of OpenCV's
    solvePnP between the tracker's points and their pixels."""
    axis: Row | None = None
    """Direction from the tip to the hand, in the tool's own axes. Empty: only the tips are looked for."""
    names: tuple[str, ...] = ()
    """Names of the poses, as `TipToWorldTransform` of `TipToWorldTransform_x`. Empty: all."""
    radius_mm: Positive = 2.5
    """Half the width of an instrument, with the error of its pose [mm at the tissue]."""

    @model_validator(mode="after")
    def _is_a_camera(self) -> Tips:
        if np.linalg.matrix_rank(np.array(self.projection)[:, :3]) < 3:
            raise ValueError("projection: its first three columns have to be of full rank")
        if self.axis is not None and not any(self.axis):
            raise ValueError("axis: a direction must not be zero")
        return self


class Meta(Section):
    """One recording."""

    scale_mm_per_px: Positive | Literal["unknown"] | None = None
    """Millimetres per pixel at the tissue, or `unknown`: forces are then relative. Give this or
    `calibration`; with `stereo` neither is needed, as two cameras measure it."""
    calibration: ScaleCalibration | None = None
    """A way to find the scale."""
    scale_uncertainty: Share | None = None
    """Relative standard uncertainty of the scale, e.g. 0.05. Default: 0.02, or the calibration's."""
    young_kpa: Annotated[
        Positive | None, BeforeValidator(lambda value: None if value == "unknown" else value)
    ] = None
    """Young's modulus of the tissue [kPa], or `unknown`: forces are then relative."""
    young_uncertainty: Share = 0.0
    """Relative standard uncertainty of `young_kpa`."""
    membrane: MembraneState = "unknown"
    """Whether the tissue still has its membrane (pia, arachnoid): `intact`, `stripped` or `unknown`."""
    membrane_mn_per_mm: Annotated[tuple[Positive, Positive], AfterValidator(_must_not_fall)] | None = None
    """Range of its stiffness, thickness times Young's modulus [mN/mm], e.g. of a strip that was pulled: what
    force by physics depends on most where there is a membrane. Default: not known; of an intact one 35,
    within 13 to 95 in two of three (docs/science.md, "Membrane and pulse")."""
    relaxation: PronyTerms = ()
    """Prony terms of the tissue [lost share of its stiffness, time in s], one or two: `young_kpa`, and a
    membrane's stiffness, are then instantaneous. Of swine's brain [[0.45, 0.5], [0.365, 50]] (Miller &
    Chinzei, J. Biomech. 35, 2002). Default: elastic, `young_kpa` is what a contact's duration leaves."""
    poisson: Annotated[tuple[PoissonsRatio, PoissonsRatio], AfterValidator(_must_not_fall)] = (0.4, 0.49)
    """Range of the tissue's Poisson's ratio."""
    alpha: Annotated[tuple[OgdenExponent, OgdenExponent], AfterValidator(_must_not_fall)] = (-20.0, 2.0)
    """Range of the exponent of Ogden's law, by which tissue stiffens where two cameras see it strained beyond
    some 30%: of swine -4.7, of human brain about -20 (docs/science.md), of soft gels about 2."""
    fps: Positive | None = None
    """Frames per second, for frames/*.png without frames.csv."""
    start: Literal["picture", "file"] = "picture"
    """What is at t = 0 of a video without frames.csv: its first `picture`, or the start of its `file`, with
    which sound, or pictures that can't be decoded, may begin earlier."""
    stream: Annotated[int, Field(ge=0, le=1000)] | None = None
    """Number of the film in a video that holds several, from 0; covers don't count."""
    rest_frame: Annotated[int, Field(ge=0, le=10**9)] = 0
    """Number of a frame with the tissue unloaded; displacement is measured from it."""
    press_s: Span | None = None
    """Span of video time with a separate press for calibrating the gain [s]; it is not scored."""
    tissue: Literal["brain", "ex-vivo", "phantom"] = "brain"
    """`brain`: it may pulsate, by up to 0.8 mm, unless the video shows otherwise. `ex-vivo`: it does not.
    `phantom`: nor does it, and larger forces than those a brain withstands are accepted."""
    specimen: str = ""
    """Name of the specimen; recordings of the same specimen are not treated as independent."""
    stereo: Stereo | None = None
    """For a recording with a right camera."""
    depth: Depth | None = None
    """For a recording with a depth camera."""
    tips: Tips | None = None
    """For a recording with poses of instruments (poses.csv): where masks expect them."""
    sensor: SensorMeta = SensorMeta()
    sync: Sync = Sync()
    pulse: PulseMeta = PulseMeta()

    @property
    def may_pulsate(self) -> bool:
        """Whether heart and breath may move the tissue."""
        return self.tissue == "brain"

    @property
    def is_scale_measured(self) -> bool:
        """Whether two cameras measure the scale."""
        return self.scale_mm_per_px is None and self.calibration is None

    @model_validator(mode="after")
    def _scale_is_known(self) -> Meta:
        if self.scale_mm_per_px is not None and self.calibration is not None:
            raise ValueError("give either scale_mm_per_px or calibration")
        if (self.scale_mm_per_px, self.calibration, self.stereo) == (None, None, None):
            raise ValueError(
                "give scale_mm_per_px or calibration, or stereo, whose cameras measure the scale"
            )
        if self.stereo is not None and self.depth is not None:
            raise ValueError("give stereo or depth, not both")
        if self.scale_mm_per_px == "unknown" and (self.stereo or self.depth) is not None:
            raise ValueError("two cameras measure the scale, a depth camera needs it: not unknown")
        if self.sync.method == "correlate" and self.sync.calibration_s is None:
            raise ValueError("sync.method correlate needs sync.calibration_s")
        return self


def document_meta() -> str:
    """A meta.yaml with every key, its meaning and its default; the scale is set to unknown."""
    return "\n".join(section_lines(Meta(scale_mm_per_px="unknown"))).rstrip() + "\n"


def read_meta(path: Path) -> Meta:
    """The recording's `meta.yaml`. UserError: no such file, not YAML, or wrong fields, one line each."""
    if not os.path.lexists(path):
        raise UserError(f"{path}: missing; a recording needs at least its scale in it")
    text = checked_file.read_text(path, checked_file.LARGEST_YAML)
    config = ConfigFile(text, str(path))
    return config.validate(Meta, _find_files_outside(config, path.parent))


def _find_files_outside(config: ConfigFile, folder: Path) -> Iterator[Mistake]:
    """Yields the keys that name a file outside the recording's folder: absolute, with .., or by a link."""
    for key in (("stereo", "calibration"), ("calibration", "checkerboard")):
        section = config.values.get(key[0])
        if isinstance(section, dict) and isinstance(name := section.get(key[1]), str):
            try:
                inside = (folder / name).resolve().is_relative_to(folder.resolve())
            except (RuntimeError, ValueError, OSError):  # a NUL, a loop of links, too long
                inside = False
            if not inside:
                yield Mistake(key, f"{name[:80]!r} must be a file in the recording's folder: copy it there")
