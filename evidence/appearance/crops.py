"""Crops of a photograph and of rendered frames at the same scale, with the same noise and codec."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from evidence.flow.scenes import jpeg
from evidence.render.case import case
from evidence.render.picture_statistics import Picture, corners
from evidence.render.realism import outlined, scaled_photograph
from synth.errors import UserError
from synth.fit.photograph import Photograph
from synth.job.schema import Job

Places = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SIDE_PX = 128
_NOISE, _QUALITY = 2.0, 90  # grey levels; of JPEG
MM_PER_PX = 0.0547  # of all crops


def of_photograph(photo: Path, outline: str, width_mm: float, step: int = 56) -> tuple[Picture, Places]:
    """Crops (N, 128, 128, 3) of the photograph inside an outline, and their corners (N, 2) in it [px].

    Raises:
        UserError: the file is not an image, or no crop fits.
    """
    image = scaled_photograph(photo, width_mm / MM_PER_PX)
    found = corners(outlined(outline, image.shape[:2]), SIDE_PX, step)
    if not found:
        raise UserError(f"{photo}: no crop of {SIDE_PX} px fits inside the outline")
    return _cut(taken(image, 0), found), np.array(found, float)


def of_job(job: Job, step: int = 64) -> tuple[Picture, Ints]:
    """Crops of tissue in the first frame of each sequence, without instruments; and their sequence (N,)."""
    field = job.render.size[0] * MM_PER_PX
    keys = job.model_dump()
    keys["render"] |= {"tool": False, "field_mm": (field, field)}
    keys["sensor"]["bitrate_mbps"] = None  # `taken` applies the codec
    bare = Job.model_validate(keys)
    pictures, of = [], []
    for index in range(job.sequences):
        one = case(bare, index)
        shot = one.renderer.render(one.state(), seed=index)
        inside = cv2.erode(one.renderer.rest.tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        found = corners(inside, SIDE_PX, step)
        pictures.append(_cut(taken(shot.rgb, index + 1), found))
        of += [index] * len(found)
    return np.concatenate(pictures), np.array(of)


def without(given: Photograph, places: Places) -> Photograph:
    """The photograph with the pixels of some crops marked as unusable."""
    usable, scale = given.usable.copy(), MM_PER_PX / given.mm_per_px
    for x, y in places:
        rows, columns = (slice(int(scale * at), int(scale * (at + SIDE_PX)) + 1) for at in (y, x))
        usable[rows, columns] = False
    return given._replace(usable=usable)


def read_job(sections: dict[str, Any], frames: int, seed: int, width_mm: float) -> Job:
    """The job whose frames are compared: a default one with the sections fitted by `synth fit`.

    The fitted vignetting is that of the whole photograph, `width_mm` wide. These frames correspond to a piece
    of its centre, where vignetting is less by the square of the width.
    """
    job = Job.model_validate({"sequences": frames, "seed": seed, **sections})
    if not sections:
        return job
    share = min(1.0, job.render.size[0] * MM_PER_PX / width_mm)
    sensor = job.sensor.model_copy(update={"vignette": job.sensor.vignette * share**2})
    return job.model_copy(update={"sensor": sensor})


def taken(rgb: Picture, seed: int) -> Picture:
    """The image with the noise and JPEG compression common to all crops."""
    noise = np.random.default_rng([seed, 5]).normal(0, _NOISE, rgb.shape)
    return jpeg(np.clip(rgb + noise, 0, 255).astype(np.uint8), _QUALITY)


def _cut(rgb: Picture, found: list[tuple[int, int]]) -> Picture:
    crops = [rgb[y : y + SIDE_PX, x : x + SIDE_PX] for x, y in found]
    return np.asarray(crops, np.uint8).reshape(-1, SIDE_PX, SIDE_PX, 3)
