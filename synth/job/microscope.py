"""The job's sections on lighting, camera and image sensor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, ValidationInfo, model_validator

from synth.job.types import Curve, Distortion, NonNegative, Positive, Range, Scenery, Section, Share, Weights
from synth.plugins import STORED
from synth.system import camera_file

BLUR_WIDTH_PX = 640.0  # of the picture that `sensor.blur_px` refers to


class LightSection(Section):
    """The microscope's lamps."""

    glare: Range[Share] = (0.0, 0.3)
    """Specular highlights: from 0, as few as with lamps next to the lens (0.5% of the tissue), to 1, 20 times
    as many."""
    tilt_deg: Range[Annotated[FiniteFloat, Field(ge=0, le=40)]] | None = None
    """Angle between main lamp and optical axis, 0-40, in any direction. Empty: at most 6.5, set by
    `glare`."""
    main: Range[Share] = (0.5, 0.68)
    """Share of light from the main lamp; the rest comes from one on the other side of the lens."""
    even: Range[Positive] = (0.35, 0.5)
    """Radius of the lamps' spot, in widths of the field: light falls smoothly, by a third to there."""


class SensorSection(Section):
    """The camera's image sensor and video processor."""

    exposure: Range[Positive] = (0.98, 1.12)
    """Share of full scale that a white surface at the craniotomy fills."""
    full_well: Range[Positive] = (8_000.0, 20_000.0)
    """Photoelectrons at full scale: photon noise is the square root of their number."""
    read_noise: Range[NonNegative] = (8.0, 14.0)
    """Noise of the readout, standard deviation [electrons]."""
    vignette: Share = 0.15
    """Share of light lost in the picture's corners."""
    blur_px: Range[Annotated[FiniteFloat, Field(ge=0, le=8)]] = (0.4, 1.2)
    """Blur of lens, colour filter and recorder in addition to the aperture's: standard deviation of a
    Gaussian in a picture 640 wide [px], in proportion to the width of others (0.4 times in one of 256).
    Default: from a full HD camera, scaled down, to one of 640 x 480 with a recorder of 320 lines."""
    matrix: tuple[Weights, Weights, Weights] | None = None
    """Colour matrix from sensor to picture, in linear light: rows for red, green, blue, each summing to 1 to
    keep white. Empty: that of a camera drawn from a few."""
    curves: tuple[Curve, Curve, Curve] | None = None
    """Tone curves of red, green, blue: rising video levels, 1 is white, at 0.05, 0.2, 0.5, 1 and 2 times full
    scale. Empty: those of the same camera."""
    sharpening: Range[NonNegative] = (0.15, 0.4)
    """Unsharp mask, as a share of the detail."""
    chroma: Literal["4:4:4", "4:2:2", "4:2:0"] = "4:4:4"
    """Chroma subsampling of the video stream: none, horizontal, or horizontal and vertical."""
    bitrate_mbps: Positive | None = None
    """Bitrate of H.264 compression on the way to the recorder [Mbit/s]. Empty: no compression."""
    shutter: Share = 0.0
    """Exposure time as a share of the time between frames: motion blur, averaged over four renderings."""


class RenderSection(Section):
    """The microscope and its picture."""

    size: tuple[Annotated[int, Field(ge=16, le=4096)], Annotated[int, Field(ge=16, le=4096)]] = (640, 480)
    """Width, height of the picture [px]."""
    spp: Annotated[int, Field(ge=1, le=4096)] = 4
    """Light paths per pixel. Flow does not improve beyond 4-8."""
    variant: Literal["auto", "llvm_ad_rgb", "scalar_rgb", "cuda_ad_rgb"] = "auto"
    """Mitsuba variant; auto is llvm_ad_rgb if LLVM works, else scalar_rgb."""
    field_mm: Range[Positive] = (32.0, 38.0)
    """Width of the field of view at the craniotomy [mm]."""
    working_distance_mm: Range[Positive] = (280.0, 320.0)
    """Distance from the front lens to the craniotomy [mm]."""
    tilt_deg: Range[Annotated[FiniteFloat, Field(ge=0, le=85)]] = (0.0, 20.0)
    """Angle between the optical axis and the craniotomy's normal, 0-85."""
    aperture_mm: Annotated[FiniteFloat, Field(ge=0, le=100)] = 4.0
    """Radius of the lens aperture [mm]; 0 is a pinhole."""
    distortion: Distortion = (-0.05, 0.01, 0.0, 0.0, 0.0)
    """Brown-Conrady k1, k2, p1, p2, k3."""
    calibration: Path | None = None
    """Camera calibration of OpenCV, ROS or Kalibr (YAML, XML, JSON, INI), relative to the job file; it
    replaces field_mm and distortion, and sets the principal point. One of a pair (K1, D1, K2, D2, R, T in mm
    of `stereoCalibrate`) gives a stereo dataset with that right camera, and replaces stereo_mm."""
    drift_mm: Range[NonNegative] = (0.0, 0.0)
    """Slow drift of the microscope over some seconds [mm]; it is part of the flow."""
    stereo_mm: Annotated[FiniteFloat, Field(ge=0, le=1000)] = 0.0
    """Baseline to a right camera [mm], for a stereo dataset: its pictures, and motion in three dimensions,
    true and recovered; 0: monocular."""
    scenery: tuple[Scenery, ...] = ("retractor", "bone", "drape", "clips", "hooks", "patties")
    """Objects around the opening, each in a share of the sequences: a retractor's blade over its edge (30%),
    the bone's cut edge (50%), drapes in the corners (40%), clips (55%) and hooks (30%) on the cut skin,
    patties of cotton on the rim (35%). They hide tissue and don't count as tissue."""

    @model_validator(mode="after")
    def _calibration_replaces_keys(self, info: ValidationInfo) -> RenderSection:
        if self.calibration is None or info.context is STORED:
            return self
        baseline_mm = round(camera_file.find_baseline_mm(self.calibration), 9)
        for name in ("field_mm", "distortion", *(["stereo_mm"] if baseline_mm else [])):
            defaults = (
                type(self).model_fields[name].default,
                baseline_mm,
            )  # a stored job has that of its calibration
            if getattr(self, name) not in defaults:
                raise ValueError(f"{name}: render.calibration sets it; leave one of the two out")
        if baseline_mm:
            object.__setattr__(self, "stereo_mm", baseline_mm)
        return self
