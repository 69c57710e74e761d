"""Whether `synth fit` finds what a picture was made with, and how near it comes to a photograph."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
import typer

from evidence.measuring import measuring
from evidence.render.case import case
from synth.fit import fitting, parameters, search
from synth.job.schema import Family, Job
from synth.render.appearance.light import balance
from synth.sequence import scenario

Picture = npt.NDArray[np.uint8]

_SIZE, _FIELD_MM, _RADIUS_MM = (864, 648), 47.0, 21.0
_QUALITY = 88  # of JPEG, colour at half the resolution
MADE: tuple[tuple[str, Family, int, dict[str, float]], ...] = (
    (
        "hyperaemic, soft",
        "hyperaemic",
        5,
        {
            "density": 1.35,
            "calibre": 0.85,
            "arterial": 1.9,
            "glare": 0.3,
            "vignette": 0.4,
            "blur": 0.9,
            "noise": 2.5,
        },
    ),
    (
        "pale, noisy",
        "pale",
        6,
        {
            "density": 0.8,
            "calibre": 1.3,
            "arterial": 0.8,
            "glare": 0.1,
            "vignette": 0.3,
            "blur": 0.5,
            "noise": 4.0,
        },
    ),
)
"""Name, family, seed and what of the parameters is not the family's."""


@measuring("--photo cortex.jpg", file="fit.json", out="docs/results/render/look")
def fit(
    photo: Annotated[Path | None, typer.Option(help="Also a photograph of exposed cortex.")] = None,
    width_mm: Annotated[float, typer.Option(help="What the photograph's width spans.")] = 110.0,
    rounds: Annotated[int, typer.Option(min=2, help="Of the search.")] = 4,
    anatomies: Annotated[int, typer.Option(min=1, help="Rendered in each round.")] = 2,
    keep: Annotated[
        Path | None, typer.Option(help="Folder for jobs and pictures; they are not results.")
    ] = None,
) -> dict[str, Any]:
    """Parameters found against those that two pictures were made with, and distances before and after."""
    pictures, rows = [], []
    with tempfile.TemporaryDirectory() as temporary:
        folder = keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if photo is not None:
            pictures.append(_distance("photograph", _fitted(photo, width_mm, rounds, anatomies, folder)))
        for name, family, seed, turned in MADE:
            asked = parameters.start(family) | turned
            file = folder / f"{family}.jpg"
            known = write_picture(file, asked, family, seed)
            found = _fitted(file, _FIELD_MM, rounds, anatomies, folder)
            pictures.append(_distance(name, found))
            rows += compare(name, known, found.fitted.values, found.fitted.unsure)
    return {"rounds": rounds, "anatomies": anatomies, "pictures": pictures, "parameters": rows}


def write_picture(path: Path, values: dict[str, float], family: Family, seed: int) -> dict[str, float]:
    """A frame of known parameters with an instrument in it, as a JPEG; what isn't given is drawn.

    Returns the parameters as they were drawn: colours as the camera's white balance shows them.
    """
    sections = parameters.as_job(values, family)
    job = Job.model_validate(
        {
            **sections,
            "seed": seed,
            "anatomy": {**sections["anatomy"], "vertices": 12000, "craniotomy": {"radius_mm": _RADIUS_MM}},
            "render": {"size": _SIZE, "field_mm": _FIELD_MM, "tilt_deg": [0, 8]},
        }
    )
    one = case(job, 0)
    shot = one.studio.frame(one.vertices, one.tips, one.shafts, seed=seed)
    settings = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x221111]
    cv2.imwrite(str(path), shot.rgb[..., ::-1], settings)
    look = scenario.draw(job, 0).look
    tint = np.asarray(look.sensor.white) / balance(look.light.kelvin)
    colours = {name: np.asarray(getattr(look, name)) * tint for name in ("crown", "flush", "vein", "wine")}
    drawn_ones = {f"{name} {k}": float(c[i]) for name, c in colours.items() for i, k in enumerate("rgb")}
    return values | drawn_ones


def compare(
    name: str, known: dict[str, float], found: dict[str, float], unsure: dict[str, float]
) -> list[dict[str, Any]]:
    """Known and found value of each parameter, of a colour that channel that is farthest off.

    The error is relative, of `blur` and `glare` absolute, since they may be nothing. `sd` is what the fit
    says of itself, on the parameter's scale, and `decided` whether the picture then tells it within 15%.
    """
    worst: dict[str, tuple[float, str]] = {}
    for one in parameters.PARAMETERS:
        off = abs(found[one.name] / known[one.name] - 1)
        worst[one.name.split()[0]] = max(worst.get(one.name.split()[0], (-1.0, "")), (off, one.name))
    rows = []
    for short, (off, full) in worst.items():
        truth, value = known[full], found[full]
        error = value - truth if full in ("blur", "glare") else value / truth - 1
        rows.append(
            {
                "picture": name,
                "parameter": short,
                "known": float(f"{truth:.3g}"),
                "found": float(f"{value:.3g}"),
                "error": round(error, 3),
                "within_15": off <= 0.15,
                "sd": round(unsure[full], 2) if full in unsure else None,
                "decided": unsure.get(full, np.inf) <= search.DECIDED,
            }
        )
    return rows


def _fitted(photo: Path, width_mm: float, rounds: int, anatomies: int, folder: Path) -> fitting.Outcome:
    out = folder / f"look-{photo.stem}.yaml"
    sheet = folder / f"fit-{photo.stem}.jpg"

    def said(turn: int, at: float) -> None:
        print(f"{photo.stem}: round {turn} of {rounds}, distance {at:.3f}", file=sys.stderr, flush=True)

    return fitting.fit_photograph(photo, out, width_mm, None, sheet, rounds, anatomies, said)


def _distance(name: str, found: fitting.Outcome) -> dict[str, Any]:
    return {
        "picture": name,
        "nearest_family": found.fitted.family,
        "cortex_mm2": round(found.cortex_mm2),
        "before": round(found.before, 3),
        "after": round(found.after, 3),
        "ratio": round(found.after / found.before, 3),
        "at_a_limit": ", ".join(found.fitted.bounded),
    }
