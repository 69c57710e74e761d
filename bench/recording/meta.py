"""`meta.yaml`: what a lab must say about its recording that the video and the sensor file don't."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, model_validator

from synth.errors import UserError
from synth.job.types import MembraneState, Positive, Section
from synth.job.writer import section_lines
from synth.system import checked_file
from synth.system.config_file import ConfigFile

Share = Annotated[FiniteFloat, Field(ge=0, lt=1)]
Point = tuple[FiniteFloat, FiniteFloat]
PoissonsRatio = Annotated[FiniteFloat, Field(ge=0, lt=0.5)]
Corners = Annotated[int, Field(ge=2)]
Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


def _must_run_forward(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] >= span[1]:
        raise ValueError("a span must end after its beginning")
    return span


def _must_not_fall(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError("the lower end comes first")
    return span


Span = Annotated[tuple[FiniteFloat, FiniteFloat], AfterValidator(_must_run_forward)]


class ScaleCalibration(Section):
    """How to find the scale when it isn't stated. Give one of the ways."""

    focal_px: Positive | None = None
    """Focal length [px]; with `distance_mm`."""
    distance_mm: Positive | None = None
    """Distance from the lens to the tissue [mm]; with `focal_px`."""
    bar_px: tuple[Point, Point] | None = None
    """Ends of a scale bar, or the two sides of an instrument of known width, as (x, y) [px]."""
    bar_mm: Positive | None = None
    """Its length [mm]."""
    checkerboard: Path | None = None
    """Picture of a checkerboard lying on the tissue plane, in the recording's folder."""
    corners: tuple[Corners, Corners] | None = None
    """Inner corners of the board: columns, rows."""
    square_mm: Positive | None = None
    """Side of one of its squares [mm]."""
    travel_px: tuple[Point, Point] | None = None
    """Where the tool tip was before and after a known move parallel to the tissue plane, as (x, y) [px]."""
    travel_mm: Positive | None = None
    """Length of that move [mm]."""

    @model_validator(mode="after")
    def _exactly_one_way(self) -> ScaleCalibration:
        ways = (
            (self.focal_px, self.distance_mm),
            (self.bar_px, self.bar_mm),
            (self.checkerboard, self.corners, self.square_mm),
            (self.travel_px, self.travel_mm),
        )
        begun = [way for way in ways if any(part is not None for part in way)]
        if len(begun) != 1 or any(part is None for part in begun[0]):
            raise ValueError(
                "give one whole way: focal_px + distance_mm, bar_px + bar_mm, "
                "checkerboard + corners + square_mm, or travel_px + travel_mm"
            )
        return self


class SensorMeta(Section):
    """The force sensor and how its file is to be read."""

    axes: Literal["camera", "sensor"] = "sensor"
    """`camera`: fx, fy, fz are along the camera's x (right), y (down), z (away), so that components are
    scored too. `sensor`: only the magnitude is."""
    to_camera: tuple[Row, Row, Row] | None = None
    """Rows of the rotation from the sensor's axes to the camera's; with it components are scored too."""
    turn_s: Span | None = None
    """Span of video time in which the tool pulls and pushes in many directions [s]: that rotation is found on
    it, and it is left out of the scores."""
    acts_on: Literal["tissue", "tool"] = "tissue"
    """On what the written force acts; a force on the tool is turned round."""
    low_pass_hz: Positive | None = 10.0
    """The one low-pass applied to the sensor (zero-phase, 4th-order Butterworth) [Hz]; null: none."""
    free_s: tuple[Span, ...] = ()
    """Spans without contact, (from, to) on the sensor's clock [s]: for tare, drift and noise floor."""
    mass_g: Annotated[FiniteFloat, Field(ge=0)] = 0.0
    """Mass beyond a tool-mounted sensor [g], for gravity; needs columns gx, gy, gz in force.csv: the unit
    vector along gravity in the sensor's axes."""

    @model_validator(mode="after")
    def _has_one_rotation(self) -> SensorMeta:
        if self.to_camera is not None:
            rows = np.array(self.to_camera)
            if not np.allclose(rows @ rows.T, np.eye(3), atol=0.02) or np.linalg.det(rows) < 0:
                raise ValueError("to_camera must be a rotation: three unit rows, square to one another")
        if self.turn_s is not None and self.in_camera_axes:
            raise ValueError("turn_s finds what to_camera or axes: camera says: give one of them")
        return self

    @property
    def in_camera_axes(self) -> bool:
        """Whether force components are along the camera's axes, by themselves or once turned."""
        return self.axes == "camera" or self.to_camera is not None


class Sync(Section):
    """How the sensor's clock lies on the video's."""

    method: Literal["clock", "offset", "correlate"] = "clock"
    """`clock`: both files share one. `offset`: `offset_s` (a trigger) is stated. `correlate`: found on
    `calibration_s`, then frozen."""
    offset_s: FiniteFloat = 0.0
    """Added to the sensor's times to give the video's [s]."""
    calibration_s: Span | None = None
    """Span of video time on which `correlate` may look [s]; it is left out of the scores."""
    search_s: Positive = 0.5
    """Largest offset looked for, either way [s]."""


class PulseMeta(Section):
    """The tissue's own motion by heart and breath, which is taken off before any method reads the motion."""

    remove: bool = True
    """`false`: leave it in."""
    free_s: tuple[Span, ...] = ()
    """Spans of video time without contact, (from, to) [s], to find it on; without, the video alone says."""


class Stereo(Section):
    """The second eye of `right.mp4` or `right/`."""

    calibration: Path
    """The pair's calibration as OpenCV writes it (K1, D1, K2, D2, R, T), in the recording's folder; for
    pictures of the size that the recording has."""
    mm_per_unit: Positive = 1.0
    """Millimetres in a unit of T: the side of a chessboard's square, say."""


class Depth(Section):
    """The depth pictures of `depth/`, on the video's pixels."""

    focal_px: Positive
    """Focal length of the video's pictures [px]."""
    centre_px: Point | None = None
    """Principal point (x, y) [px]; the middle if not given."""
    mm_per_unit: Positive = 1.0
    """Millimetres in a unit of the pictures: 1 for the 16-bit PNG of most depth cameras."""


class Meta(Section):
    """One recording."""

    scale_mm_per_px: Positive | Literal["unknown"] | None = None
    """Millimetres a pixel at the tissue, or `unknown`: then only relative force is known. This or
    `calibration`."""
    calibration: ScaleCalibration | None = None
    """How to find the scale."""
    scale_uncertainty: Share | None = None
    """Relative standard uncertainty of the scale, e.g. 0.05. Default: 0.02, or the calibration's."""
    young_kpa: Annotated[
        Positive | None, BeforeValidator(lambda value: None if value == "unknown" else value)
    ] = None
    """Young's modulus of the tissue [kPa], or `unknown`: then only relative force is known."""
    young_uncertainty: Share = 0.0
    """Relative standard uncertainty of `young_kpa`."""
    membrane: MembraneState = "unknown"
    """Whether the tissue still has its membrane (pia, arachnoid): `intact`, `stripped` or `unknown`."""
    poisson: Annotated[tuple[PoissonsRatio, PoissonsRatio], AfterValidator(_must_not_fall)] = (0.4, 0.49)
    """Between which the tissue's Poisson's ratio lies."""
    fps: Positive | None = None
    """Frames a second, for frames/*.png without frames.csv."""
    rest_frame: Annotated[int, Field(ge=0)] = 0
    """Frame with the tissue unloaded; displacement is measured from it."""
    press_s: Span | None = None
    """Span of video time holding a separate press for calibrating one gain [s]; left out of the scores."""
    tissue: Literal["brain", "phantom"] = "brain"
    """`phantom`: made to be pushed hard, so that forces beyond any brain's are no mistake."""
    specimen: str = ""
    """Name of the specimen; recordings of one specimen are never treated as independent."""
    stereo: Stereo | None = None
    """Of a recording with a second eye."""
    depth: Depth | None = None
    """Of a recording with a depth camera."""
    sensor: SensorMeta = SensorMeta()
    sync: Sync = Sync()
    pulse: PulseMeta = PulseMeta()

    @model_validator(mode="after")
    def _scale_is_known(self) -> Meta:
        if (self.scale_mm_per_px is None) == (self.calibration is None):
            raise ValueError("give either scale_mm_per_px or calibration")
        if self.stereo is not None and self.depth is not None:
            raise ValueError("give stereo or depth, not both")
        if self.scale_mm_per_px == "unknown" and (self.stereo or self.depth) is not None:
            raise ValueError("a second eye measures in millimetres: give the scale")
        if self.sync.method == "correlate" and self.sync.calibration_s is None:
            raise ValueError("sync.method correlate needs sync.calibration_s")
        return self


def commented() -> str:
    """A meta.yaml with every key, its meaning and its default; the scale, which has none, is unknown."""
    return "\n".join(section_lines(Meta(scale_mm_per_px="unknown"))).rstrip() + "\n"


def read_meta(path: Path) -> Meta:
    """The recording's `meta.yaml`.

    Raises:
        UserError: no such file, not YAML, or a line for each field that is wrong.
    """
    if not os.path.lexists(path):
        raise UserError(f"{path}: missing; a recording needs at least scale_mm_per_px there")
    text = checked_file.read_text(path, checked_file.LARGEST_YAML)
    return ConfigFile(text, str(path)).validate(Meta)
