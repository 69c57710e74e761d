"""The job's sections on light, camera and chip: how the surface is seen and recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from synth.job.types import Curve, NonNegative, Positive, Range, Section, Share, Weights


class LightSection(Section):
    """The microscope's lamps."""

    glare: Range[Share] = (0.0, 0.3)
    """Wet highlights: 0 as few as lamps beside the lens leave (0.5% of the tissue), 1 twenty times more."""
    tilt_deg: Range[Annotated[FiniteFloat, Field(ge=0, le=40)]] | None = None
    """Angle between main lamp and optical axis, 0-40, to any side. Empty: at most 6.5, as `glare` asks."""
    main: Range[Share] = (0.5, 0.68)
    """Share of light from the main lamp; the rest comes from one across the lens."""
    even: Range[Positive] = (0.35, 0.5)
    """Radius of the evenly lit spot, in widths of the field; beyond it the light falls off."""


class SensorSection(Section):
    """The camera's chip and what its video processor makes of it."""

    exposure: Range[Positive] = (0.98, 1.12)
    """Share of full scale that a white surface at the craniotomy fills."""
    full_well: Range[Positive] = (8_000.0, 20_000.0)
    """Photoelectrons at full scale: photon noise is the root of what is counted."""
    read_noise: Range[NonNegative] = (8.0, 14.0)
    """Noise of the readout, standard deviation [electrons]."""
    vignette: Share = 0.15
    """Share of light lost in the picture's corners."""
    blur_px: Annotated[FiniteFloat, Field(ge=0, le=8)] = 0.0
    """Blur of the optics beyond the aperture's: standard deviation of a Gaussian [px]."""
    matrix: tuple[Weights, Weights, Weights] | None = None
    """From the chip's colours to the picture's, in linear light: rows for red, green, blue, each summing
    to 1 where white is to stay white. Empty: that of a camera drawn from a few."""
    curves: tuple[Curve, Curve, Curve] | None = None
    """Tone curves of red, green, blue: rising video levels, 1 is white, at 0.05, 0.2, 0.5, 1 and 2 times full
    scale. Empty: those of the same camera."""
    sharpening: Range[NonNegative] = (0.15, 0.4)
    """Unsharp mask, as a share of the detail."""
    chroma: Literal["4:4:4", "4:2:2", "4:2:0"] = "4:4:4"
    """Colour resolution in the video stream: full, half across, half across and down."""
    bitrate_mbps: Positive | None = None
    """H.264 on the way to the recorder at so many megabits a second. Empty: not compressed."""
    shutter: Share = 0.0
    """Part of the time between frames in which light is gathered: motion blur, of four pictures each."""


class RenderSection(Section):
    """The microscope and its picture."""

    size: tuple[Annotated[int, Field(ge=16, le=4096)], Annotated[int, Field(ge=16, le=4096)]] = (640, 480)
    """Width, height of the picture [px]."""
    spp: Annotated[int, Field(ge=1, le=4096)] = 4
    """Light paths a pixel. Flow stops improving at 4-8."""
    variant: Literal["auto", "llvm_ad_rgb", "scalar_rgb", "cuda_ad_rgb"] = "auto"
    """Mitsuba variant; auto takes llvm_ad_rgb where an LLVM works, else scalar_rgb."""
    field_mm: Range[Positive] = (32.0, 38.0)
    """Width of the field of view at the craniotomy [mm]."""
    working_distance_mm: Range[Positive] = (280.0, 320.0)
    """Distance from the front lens to the craniotomy [mm]."""
    tilt_deg: Range[NonNegative] = (0.0, 20.0)
    """Angle between the optical axis and the craniotomy's normal."""
    aperture_mm: NonNegative = 4.0
    """Radius of the lens aperture [mm]; 0 is a pinhole."""
    distortion: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] = (
        -0.05,
        0.01,
        0.0,
        0.0,
        0.0,
    )
    """Brown-Conrady k1, k2, p1, p2, k3."""
    calibration: Path | None = None
    """Calibration of a camera as OpenCV writes it (YAML, XML, JSON), relative to the job file; it takes the
    place of field_mm and distortion, and sets the principal point."""
    drift_mm: Range[NonNegative] = (0.0, 0.0)
    """Slow drift of the microscope over some seconds [mm]; it is part of the flow."""
    stereo_mm: NonNegative = 0.0
    """Distance of a second lens to the right [mm], for a stereo dataset: its pictures, and motion in three
    dimensions, true and recovered; 0: there is none."""
    tool: bool = True
    """Show the instrument."""
    scenery: tuple[Literal["retractor", "cottonoid", "bone", "drape"], ...] = ()
    """What else may lie about the opening, each in three of four sequences: a retractor's blade and cotton
    patties over its edge, the bone's cut edge, drapes in the corners. It hides tissue and is none."""
