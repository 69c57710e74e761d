"""The field table: every array of a sequence, declared once for writer, reader, checks, card and docs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

TIME, ROW, COLUMN, INSTRUMENT = "frame", "row", "column", "instrument"
MOST_INSTRUMENTS = 3  # at once
Stored = Literal["always", "loaded", "usually", "several", "recovered", "stereo", "stereo recovered", "extra"]


@dataclass(frozen=True)
class Field:
    """One array of a sequence."""

    name: str
    dims: tuple[str, ...]  # names of the axes
    dtype: str
    unit: str
    meaning: str
    length: int = 0  # of the axis that is neither frame, row, column nor instrument
    stored: Stored = "always"
    half: bool = False  # whether `store.flow: float16` stores it as float16
    packed: float = 0.1  # stored size over raw size, measured on rendered sequences, for forecasts
    low: float | None = None  # smallest plausible value, checked by `synth verify`
    high: float | None = None  # largest plausible value, checked by `synth verify`

    @property
    def framed(self) -> bool:
        """Whether it has one slice per frame of the size of the picture."""
        return self.dims[:3] == (TIME, ROW, COLUMN)

    def shape(self, frames: int, size: tuple[int, int]) -> tuple[int, ...]:
        """Shape for `frames` frames of `size` = (height, width) [px]."""
        lengths = {TIME: frames, ROW: size[0], COLUMN: size[1], INSTRUMENT: MOST_INSTRUMENTS}
        return tuple(lengths.get(dim, self.length) for dim in self.dims)


STORED_WHEN = {
    "always": "always",
    "loaded": "unless `mechanics.source` has no force",
    "usually": "unless in `store.without`",
    "several": "if the job has several instruments",
    "recovered": "with a flow estimator",
    "stereo": "with `render.stereo_mm`",
    "stereo recovered": "with `render.stereo_mm` and a flow estimator",
    "extra": "if in `store.extra`",
}
"""When a sequence has a field, by `Field.stored`."""

_STILL = (ROW, COLUMN)
_VIDEO = (TIME, ROW, COLUMN)

# fmt: off
_TABLE = (
    Field("time", (TIME,), "float64", "s",
          "time of the frame; frame 0 is the rest frame", packed=8.8, low=0.0),
    Field("rgb", (*_VIDEO, "rgb"), "uint8", "sRGB", "recorded picture", length=3, packed=0.94),
    Field("flow", (*_VIDEO, "xy"), "float32", "px",
          "true motion of the material points from the rest frame to this one, on the rest frame's "
          "pixels; 0 outside tissue", length=2, half=True, packed=0.25, low=-1e4, high=1e4),
    Field("visible", _VIDEO, "bool", "-",
          "whether the rest pixel's material point is visible in this frame: not hidden by the instrument "
          "or tissue, nor outside the picture", packed=0.008),
    Field("tissue", _STILL, "bool", "-", "brain surface, in the rest frame", packed=0.008),
    Field("tool", _VIDEO, "bool", "-", "instrument, in this frame's own pixels", packed=0.004),
    Field("glare", _VIDEO, "bool", "-", "specular highlight, in this frame's own pixels", packed=0.01),
    Field("depth", _VIDEO, "float32", "mm",
          "distance along the optical axis; 0 where nothing is hit", stored="usually", packed=0.44, low=0.0),
    Field("traction", (*_VIDEO, "xyz"), "float32", "kPa",
          "load on the tissue per rest area, camera axes, on the rest frame's pixels",
          length=3, stored="loaded", packed=0.025, low=-1e4, high=1e4),
    Field("area", _STILL, "float32", "mm^2",
          "surface area at rest that each pixel of the rest frame covers", packed=0.26, low=0.0),
    Field("force", (TIME, "xyz"), "float64", "mN",
          "total load on the tissue, camera axes", length=3, stored="loaded", packed=3.5, low=-1e6, high=1e6),
    Field("force_of", (TIME, INSTRUMENT, "xyz"), "float64", "mN",
          "load of each instrument on the tissue, camera axes, 0 beyond their number; force is their sum",
          length=3, stored="several", packed=2.0, low=-1e6, high=1e6),
    Field("flow_recovered", (*_VIDEO, "xy"), "float32", "px",
          "flow recovered from the video by the estimator in the attribute flow_backend",
          length=2, stored="recovered", half=True, packed=0.33, low=-1e4, high=1e4),
    Field("flow_confidence", _VIDEO, "float32", "-",
          "the estimator's confidence in the recovered flow, 0..1",
          stored="recovered", packed=0.24, low=0.0, high=1.0),
    Field("flow_noisy", (*_VIDEO, "xy"), "float32", "px",
          "the true motion with the published method's noise, as set by the job's key labels",
          length=2, stored="extra", packed=0.45, low=-1e4, high=1e4),
    Field("intensity", _VIDEO, "float32", "mN",
          "the published method's label: size of the load, scaled to peak at the total force, with "
          "noise as set by the job's key labels; on the rest frame's pixels",
          stored="extra", packed=0.1, low=0.0),
    Field("flow_next", (*_VIDEO, "xy"), "float32", "px",
          "true motion from this frame to the next, on this frame's pixels; 0 off tissue, and at the "
          "end", length=2, stored="extra", half=True, packed=0.4, low=-1e4, high=1e4),
    Field("flow_next_all", (*_VIDEO, "xy"), "float32", "px",
          "as flow_next, of all that the pixel shows: tissue, instruments, and what is around the opening; 0 "
          "where nothing is hit, and at the end",
          length=2, stored="extra", half=True, packed=0.4, low=-1e4, high=1e4),
    Field("normals", (*_VIDEO, "xyz"), "float32", "-",
          "unit normal of the surface at each pixel of this frame, camera axes; 0 where nothing is hit",
          length=3, stored="extra", packed=0.6, low=-1.001, high=1.001),
    Field("blur", _VIDEO, "float32", "px",
          "radius of the circle of confusion at each pixel of this frame; 0 where nothing is hit",
          stored="extra", packed=0.5, low=0.0),
    Field("shadow", _VIDEO, "float32", "-",
          "share of the lamps' direct light that instruments take from the point at each pixel of this frame"
          ", of what arrives without them; 0 on instruments and where nothing is hit",
          stored="extra", packed=0.03, low=0.0, high=1.0),
    Field("instrument", _VIDEO, "uint8", "-",
          "instrument at each pixel of this frame: 1 for the first, acting ones before idle ones; 0 for none",
          stored="extra", packed=0.01),
    Field("radiance", (*_VIDEO, "rgb"), "float16", "-",
          "linear light at the sensor, before exposure and noise; 1 is a white surface under the lamps",
          length=3, stored="extra", packed=0.9, low=0.0),
    Field("camera", (TIME, "to", "from"), "float64", "mm",
          "transform from world axes (homogeneous) to this frame's camera axes", length=4, stored="extra"),
    Field("rgb_right", (*_VIDEO, "rgb"), "uint8", "sRGB",
          "picture of the right camera, render.stereo_mm to the right of the left one",
          length=3, stored="stereo", packed=1.0),
    Field("flow_right", (*_VIDEO, "xy"), "float32", "px",
          "as flow, in the right camera's pictures; 0 outside tissue",
          length=2, stored="stereo", half=True, packed=0.4, low=-1e4, high=1e4),
    Field("visible_right", _VIDEO, "bool", "-",
          "as visible, in the right camera's pictures", stored="stereo"),
    Field("depth_right", _VIDEO, "float32", "mm",
          "as depth, in the right camera's pictures", stored="stereo", packed=0.6, low=0.0),
    Field("shadow_right", _VIDEO, "float32", "-",
          "as shadow, in the right camera's pictures", stored="extra", packed=0.03, low=0.0, high=1.0),
    Field("instrument_right", _VIDEO, "uint8", "-",
          "as instrument, in the right camera's pictures", stored="extra", packed=0.01),
    Field("motion", (*_VIDEO, "xyz"), "float32", "mm",
          "true motion of the material points from the rest frame to this one, camera axes (each "
          "frame's own), on the rest frame's pixels; 0 outside tissue",
          length=3, stored="stereo", packed=0.25, low=-1e4, high=1e4),
    Field("disparity", _STILL, "float32", "px",
          "column of a rest pixel's point in the left picture less that in the right, without distortion: "
          "K[0,0] B / depth - (K_right[0,2] - K[0,2]); 0 outside tissue",
          stored="stereo", packed=0.6, low=-1e4, high=1e4),
    Field("motion_recovered", (*_VIDEO, "xyz"), "float32", "mm",
          "motion recovered from both cameras' videos, camera axes",
          length=3, stored="stereo recovered", packed=0.7, low=-1e4, high=1e4),
    Field("motion_deviation", (*_VIDEO, "xyz"), "float32", "mm",
          "estimated standard deviation of each component of motion_recovered; 0 outside tissue",
          length=3, stored="stereo recovered", packed=0.7, low=0.0),
)
# fmt: on

FIELDS: dict[str, Field] = {field.name: field for field in _TABLE}
"""Every field by name, in the order in which they are hashed and listed."""

_RIGHT = ("rgb_right", "flow_right", "visible_right", "depth_right")

EXTRA = tuple(name for name, field in FIELDS.items() if field.stored == "extra" or name in _RIGHT)
"""Fields that a job's `store.extra` may name; those of the right camera are stored with it in any case."""

SPARED = ("depth", "flow_confidence", "flow_right", "visible_right", "depth_right")
"""Fields that a job's `store.without` may name; all others are needed."""
