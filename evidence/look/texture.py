"""Texture of crops, rendered against photograph, by the statistics of a steerable pyramid.

J. Portilla and E. P. Simoncelli, "A parametric texture model based on joint statistics of complex wavelet
coefficients", IJCV 40, 2000, as plenoptic (MIT) computes them, in an environment of its own.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from evidence.look import crops as cutting
from evidence.measuring import measuring
from evidence.render.realism import OUTLINE
from synth.errors import UserError

Floats = npt.NDArray[np.float64]

_REGIONS = 5


@measuring("cortex.jpg --python ps/bin/python", file="texture.json", out="docs/results/render/look")
def texture(
    photo: Annotated[Path, typer.Argument(help="A photograph of an exposed cortex.")],
    python: Annotated[Path, typer.Option(help="A Python that has plenoptic (pip install plenoptic).")],
    look: Annotated[
        list[Path] | None, typer.Option(help="Also a job, as synth fit writes it; repeat for more.")
    ] = None,
    outline: Annotated[
        str, typer.Option(help="Polygon of the cortex in it, as shares: x,y x,y ...")
    ] = OUTLINE,
    width_mm: Annotated[float, typer.Option(help="What the photograph's width spans.")] = 110.0,
    frames: Annotated[int, typer.Option(min=2, help="Rendered sequences, one frame of each.")] = 5,
    seed: Annotated[int, typer.Option(help="Of the rendered jobs.")] = 31,
    cache: Annotated[Path | None, typer.Option(help="Folder that keeps rendered crops.")] = None,
) -> dict[str, Any]:
    """Distance of rendered crops' texture from a photograph's, in the spread of the photograph's own."""
    theirs = cutting.of_photograph(photo, outline, width_mm, cutting.MM_PER_PX)
    measured = described(theirs.pictures, python)
    own = own_distances(measured, cutting.regions(theirs.places, _REGIONS))
    limit = float(np.quantile(own, 0.9))
    rows = [_row("photograph, region left out", own, limit)]
    for name, file in cutting.name_jobs(look):
        ours = cutting.kept_of_job(cutting.read_job(file, frames, seed, width_mm), cutting.MM_PER_PX, cache)
        found = described(ours.pictures, python)
        rows.append(_row(name, distances(found, measured), limit))
    return {
        "statistics": int(measured.shape[1]),
        "crops_photograph": len(measured),
        "limit_p90_of_photograph": round(limit, 3),
        "rows": rows,
    }


def described(pictures: npt.NDArray[np.uint8], python: Path) -> Floats:
    """Portilla-Simoncelli statistics (N, S) of the grey levels of crops (N, n, n, 3).

    Raises:
        UserError: that Python can't compute them.
    """
    grey = (pictures @ np.array([0.299, 0.587, 0.114]) / 255).astype(np.float32)
    worker = Path(__file__).with_name("texture_worker.py")
    with tempfile.TemporaryDirectory() as folder:
        given, gives = Path(folder) / "crops.npy", Path(folder) / "statistics.npy"
        np.save(given, grey)
        try:
            done = subprocess.run(
                [str(python), str(worker), str(given), str(gives)],
                capture_output=True,
                text=True,
                check=False,
            )
        except OSError as error:
            raise UserError(f"{python}: cannot be run ({error.strerror})") from None
        if done.returncode:
            last = (done.stderr.strip() or "no message").splitlines()[-1]
            raise UserError(f"{python}: plenoptic did not run ({last})")
        return np.asarray(np.load(gives), np.float64)


def centred(found: Floats, reference: Floats) -> Floats:
    """Statistics (N, S) less the reference's mean, over its spread; those that hardly vary there left out."""
    middle, spread = reference.mean(axis=0), reference.std(axis=0)
    kept = spread > 1e-9 * np.maximum(np.abs(middle), 1e-3)
    return np.asarray((found - middle)[:, kept] / spread[kept])


def distances(found: Floats, reference: Floats) -> Floats:
    """Distance (N,) of each crop: root mean square over statistics, each in the reference's spread."""
    return np.asarray(np.sqrt((centred(found, reference) ** 2).mean(axis=1)))


def own_distances(measured: Floats, region: npt.NDArray[np.int64]) -> Floats:
    """The same of the photograph's crops, each region against all others."""
    own = np.empty(len(measured))
    for k in np.unique(region):
        own[region == k] = distances(measured[region == k], measured[region != k])
    return own


def _row(name: str, own: Floats, limit: float) -> dict[str, Any]:
    low, middle, high = np.quantile(own, (0.1, 0.5, 0.9))
    return {
        "crops": name,
        "count": len(own),
        "p10": round(float(low), 3),
        "median": round(float(middle), 3),
        "p90": round(float(high), 3),
        "median_within": bool(middle <= limit),
    }
