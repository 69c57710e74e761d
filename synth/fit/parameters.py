"""What is fitted: each parameter of the job with the figure of a picture that answers to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from synth.job.schema import Family
from synth.render.appearance.family import FAMILIES

EXPOSURE = 1.05
"""Of the job, as long as no reflectance that is needed passes the brightest that tissue may have."""
CONTRAST = 0.4
"""Of the tone curve: one picture can't tell it from darker and lighter colours."""
KELVIN = 5000.0
_BRIGHTEST = 0.95
_FULL_WELL, _READ_NOISE = 12_000.0, 11.0
_SHARPENING = 0.25
_COLOURS = ("crown", "flush", "vein", "wine")
_BESIDE_DEG, _FARTHER_DEG = 6.5, 30.0  # of a lamp from the axis where `glare` is 0, and more at -1
_EVEN = 0.65  # widths of the field: the spot then reaches the corners, and `vignette` says all that is lost

Scale = Literal["log", "linear", "share"]


@dataclass(frozen=True)
class Parameter:
    """One number to find, and what rises or falls with it."""

    name: str
    effects: Mapping[str, float]
    """Change of statistics by the parameter, all on their scales, near a default job."""
    low: float
    high: float
    vague: float = 1.0
    """How far it may be from the family's, on its scale: standard deviation where pictures say little."""
    scale: Literal["log", "linear"] = "log"

    def onto(self, value: float) -> float:
        """On its scale."""
        return float(np.log(value)) if self.scale == "log" else value

    def back(self, value: float) -> float:
        """From its scale."""
        return float(np.exp(value)) if self.scale == "log" else value


def _contrast(*slopes: float) -> dict[str, float]:
    return {f"contrast {k}": slope for k, slope in enumerate(slopes)}


def _colour(name: str, channel: str) -> Parameter:
    """Vessels stand out from a brighter crown; a vein's sides hardly show but along its crest."""
    own, also = {
        "crown": (1.0, {f"flush {channel}": 0.2}),
        "flush": (0.45, {}),
        "vein": (0.6, {f"wine {channel}": 0.3}),
        "wine": (0.08, {f"vein {channel}": 0.25}),
    }[name]
    lifts = {"crown r": 0.15, "crown g": 0.35}.get(f"{name} {channel}")
    seen = _contrast(*[lifts] * 4) if lifts else {}
    return Parameter(f"{name} {channel}", {f"{name} {channel}": own, **also, **seen}, 0.01, 3.0, 0.6)


# Slopes: four anatomies of the healthy family at 0.055 mm a pixel, each parameter turned up by 0.3 on its
# scale (blur by 0.5 px).
PARAMETERS: tuple[Parameter, ...] = (
    *(_colour(name, channel) for name in _COLOURS for channel in "rgb"),
    Parameter(
        "arterial",
        {"arterial": 0.46, "density": 0.17, "sharpness": 0.15, **_contrast(0.47, 0.39, 0.31, 0.19)},
        0.15,
        4.0,
        0.4,
    ),
    Parameter(
        "density",
        {"density": 0.84, "fineness": 0.22, **_contrast(0.38, 0.35, 0.22, 0.07)},
        0.35,
        2.8,
        0.4,
    ),
    Parameter(
        "calibre",
        {
            "fineness": 0.41,
            "density": 0.1,
            "arterial": 0.24,
            "vein share": 1.1,
            **_contrast(0.28, 0.38, 0.39, 0.34),
        },
        0.3,
        3.0,
        0.4,
    ),
    Parameter(
        "glare",
        {"highlight share": 2.5, "highlight area": 1.8, "noise": 0.1},
        -1.0,
        1.0,
        0.8,
        "linear",
    ),
    Parameter("film_mm", {"highlight area": 0.35}, 0.01, 0.3, 0.5),
    Parameter(
        "vignette",
        {"vignette": 0.82},
        0.0,
        0.95,
        0.5,
        "linear",
    ),
    Parameter(
        "blur",
        {
            "sharpness": -0.46,
            "arterial": -0.28,
            "density": -0.27,
            "highlight area": 0.6,
            **_contrast(-0.54, -0.22, -0.07, -0.03),
        },
        -1.5,
        4.0,
        1.0,
        "linear",
    ),
    Parameter("noise", {"noise": 0.95}, 0.1, 8.0, 1.5),
)
"""`glare` below 0 stands for lamps farther from the axis, `blur` below 0 for sharpening; `noise` is relative
to that of 12,000 electrons at full scale."""

SPREAD = {
    **{
        f"{name} {channel}": s
        for name, s in zip(_COLOURS, (0.05, 0.05, 0.15, 0.1), strict=True)
        for channel in "rgb"
    },
    # 0.04 between anatomies; but a wider field than the frames' falls off by the brain's curvature too.
    "vignette": 0.15,
    "vein share": 0.5,
    "arterial": 0.06,
    "fineness": 0.08,
    "density": 0.12,
    "highlight share": 0.22,
    "highlight area": 0.2,
    "noise": 0.04,
    "sharpness": 0.05,
    **_contrast(*[0.05] * 4),
}
"""Of the statistics that are fitted to, on their scales: standard deviation between frames of one job."""

SCALES: dict[str, Scale] = {
    "vignette": "linear",
    "shade": "linear",
    "highlight share": "share",
    "vein share": "share",
    **{f"contrast {k}": "linear" for k in range(4)},
}
"""Of statistics; logarithmic where nothing is said."""


def scaled(statistic: str, value: float) -> float:
    """A statistic on its scale: differences are relative ones."""
    match SCALES.get(statistic, "log"):
        case "linear":
            return value
        case "share":
            return float(np.log(value + 0.003))
        case _:
            return float(np.log(max(value, 1e-6)))


def distance(ours: dict[str, float], theirs: dict[str, float]) -> float:
    """Root mean square difference of two pictures' statistics on their scales, each of 1.5 at most.

    0.3: a figure is typically a third off.
    """
    off = [scaled(name, ours[name]) - scaled(name, theirs[name]) for name in theirs]
    off = [min(abs(one), 1.5) for one in off if np.isfinite(one)]
    return float(np.sqrt(np.mean(np.square(off))))


def start(family: Family) -> dict[str, float]:
    """Parameters in the middle of a family and of the job's defaults."""
    ranges = FAMILIES[family]
    values = {f"{c} {k}": getattr(ranges, c)[i] for c in _COLOURS for i, k in enumerate("rgb")}
    values |= {name: float(np.mean(getattr(ranges, name))) for name in ("arterial", "film_mm")}
    return values | {
        "density": 1.0,
        "calibre": 1.0,
        "glare": 0.15,
        "vignette": 0.15,
        "blur": 0.0,
        "noise": 1.0,
    }


def as_job(values: dict[str, float], family: Family) -> dict[str, Any]:
    """The sections of a job that parameters stand for."""
    own: dict[str, Any] = {c: [values[f"{c} {k}"] for k in "rgb"] for c in _COLOURS}
    # What is brighter than tissue can be is a longer exposure.
    longer = max(1.0, max(max(own[c]) for c in _COLOURS) / _BRIGHTEST)
    own = {c: [float(np.clip(v / longer, 0.005, _BRIGHTEST)) for v in own[c]] for c in _COLOURS}
    own |= {name: [values[name]] * 2 for name in ("arterial", "film_mm")}
    noise, blur, glare = values["noise"], values["blur"], values["glare"]
    light = {"glare": [max(glare, 0.0)] * 2, "kelvin": [KELVIN] * 2, "power": [1.0] * 2, "even": [_EVEN] * 2}
    if glare < 0:
        light["tilt_deg"] = [_BESIDE_DEG - _FARTHER_DEG * glare] * 2
    return {
        "anatomy": {"vessel_density": values["density"], "vessel_calibre": values["calibre"]},
        "appearance": {"families": [family], "own": own},
        "light": light,
        "sensor": {
            "exposure": [EXPOSURE * longer] * 2,
            "full_well": [_FULL_WELL / noise**2] * 2,
            "read_noise": [_READ_NOISE / noise] * 2,
            "vignette": values["vignette"],
            "blur_px": max(blur, 0.0),
            "sharpening": [_SHARPENING + max(-blur, 0.0)] * 2,
            "contrast": [CONTRAST] * 2,
        },
    }
