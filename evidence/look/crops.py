"""Crops of a photograph and of rendered frames that differ in what they show, not in how they were taken.

Both are at the same scale; both get the same noise and go through the same codec last.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from evidence import kept
from evidence.render.case import case
from evidence.render.realism import outlined, scaled_photograph
from synth.errors import UserError
from synth.job import reader
from synth.job.identity import identify_job
from synth.job.schema import Job

Picture = npt.NDArray[np.uint8]

SIDE_PX = 128
_NOISE, _QUALITY = 2.0, 90  # grey levels; of JPEG
MM_PER_PX = 0.0547
"""Of all crops."""


@dataclass(frozen=True)
class Crops:
    """Crops of one source."""

    pictures: Picture
    """(N, 128, 128, 3) sRGB."""
    places: npt.NDArray[np.float64]
    """(N, 2) middles in the photograph [px]; of rendered ones the sequence, twice."""


def of_photograph(photo: Path, outline: str, width_mm: float, mm_per_px: float, step: int = 56) -> Crops:
    """Crops of the photograph that lie inside an outline.

    Raises:
        UserError: it is no picture, or no crop fits.
    """
    image = scaled_photograph(photo, width_mm / mm_per_px)
    found = _cut(taken(image, 0), outlined(outline, image.shape[:2]), step)
    if not found:
        raise UserError(f"{photo}: no crop of {SIDE_PX} px fits inside the outline")
    return Crops(np.stack([one for one, _ in found]), np.array([place for _, place in found], float))


def of_job(job: Job, mm_per_px: float, step: int = 64) -> Crops:
    """Crops of the tissue in the first frame of each of a job's sequences, without instruments."""
    field = job.render.size[0] * mm_per_px
    bare = Job.model_validate(
        {
            **job.model_dump(exclude={"render", "sensor"}),
            "render": {**job.render.model_dump(), "tool": False, "field_mm": (field, field)},
            # The codec is that of all crops.
            "sensor": {**job.sensor.model_dump(), "bitrate_mbps": None},
        }
    )
    pictures, places = [], []
    for index in range(job.sequences):
        one = case(bare, index)
        shot = one.studio.frame(one.vertices, one.tips, one.shafts, seed=index)
        inside = cv2.erode(one.studio.still.tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        for crop, _ in _cut(taken(shot.rgb, index + 1), inside, step):
            pictures.append(crop)
            places.append((index, index))
    return Crops(np.stack(pictures), np.array(places, float))


def kept_of_job(job: Job, mm_per_px: float, cache: Path | None) -> Crops:
    """The same, kept in a folder by job and code, if there is one."""
    if cache is None:
        return of_job(job, mm_per_px)
    file = cache / f"{kept.word(__name__, identify_job(job), job.sequences, mm_per_px)}.npz"
    if not file.exists():
        found = of_job(job, mm_per_px)
        cache.mkdir(parents=True, exist_ok=True)
        np.savez(file, pictures=found.pictures, places=found.places)
    with np.load(file) as told:
        return Crops(told["pictures"], told["places"])


def name_jobs(look: list[Path] | None) -> list[tuple[str, Path | None]]:
    """What is compared, by name: the default job, then files as `synth fit` writes them."""
    return [("default job", None), *((one.stem, one) for one in look or [])]


def read_job(look: Path | None, frames: int, seed: int, width_mm: float) -> Job:
    """The job whose frames are compared: the default one, or what `synth fit` wrote.

    The fitted loss of light towards the corners is the photograph's, `width_mm` wide. These frames are like a
    piece of its middle, where there is less of it: by the square of the width.
    """
    if look is None:
        return Job.model_validate({"sequences": frames, "seed": seed})
    job = reader.load_job(str(look), [f"sequences={frames}", f"seed={seed}"])
    share = min(1.0, job.render.size[0] * MM_PER_PX / width_mm)
    sensor = job.sensor.model_copy(update={"vignette": job.sensor.vignette * share**2})
    return job.model_copy(update={"sensor": sensor})


def taken(rgb: Picture, seed: int) -> Picture:
    """A picture with the same noise and codec as any other."""
    noise = np.random.default_rng([seed, 5]).normal(0, _NOISE, rgb.shape)
    noisy = np.clip(rgb + noise, 0, 255).astype(np.uint8)
    _, packed = cv2.imencode(".jpg", noisy[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return np.ascontiguousarray(np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)[..., ::-1])


def regions(places: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.int64]:
    """The region (N,) of each place: sectors round the middle with equally many crops."""
    away = places - places.mean(axis=0)
    order = np.argsort(np.arctan2(away[:, 1], away[:, 0]), kind="stable")
    sector = np.empty(len(places), np.int64)
    sector[order] = np.arange(len(places)) * count // len(places)
    return sector


def overlapping(places: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Which crops (N, N) of one picture show some of the same."""
    return np.asarray((np.abs(places[:, None] - places[None]) < SIDE_PX).all(axis=2))


def _cut(rgb: Picture, inside: npt.NDArray[np.bool_], step: int) -> list[tuple[Picture, Any]]:
    """Crops that lie wholly inside a mask, with their middles."""
    summed = cv2.integral(inside.astype(np.uint8))
    found = []
    for y in range(0, rgb.shape[0] - SIDE_PX + 1, step):
        for x in range(0, rgb.shape[1] - SIDE_PX + 1, step):
            box = (
                summed[y + SIDE_PX, x + SIDE_PX]
                - summed[y, x + SIDE_PX]
                - summed[y + SIDE_PX, x]
                + summed[y, x]
            )
            if box == SIDE_PX**2:
                found.append((rgb[y : y + SIDE_PX, x : x + SIDE_PX], (x + SIDE_PX / 2, y + SIDE_PX / 2)))
    return found
