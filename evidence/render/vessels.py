"""Vessels in renderings and in a photograph, which is not stored, segmented by one ridge filter."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import skimage
from scipy.ndimage import center_of_mass, convolve, distance_transform_edt, label

from evidence import report, status
from evidence.render.photograph import OUTLINE, bare_picture, outlined, scaled_photograph
from evidence.study import Study
from synth.job.schema import Job

_TOOLS: Any = skimage  # without types
_CALIBRES = (0.0, 0.25, 0.45, 0.9, 1.8, 9.0)  # mm


def statistics(rgb: Any, inside: Any, mm: float) -> dict[str, Any]:
    """Length [mm], tortuosity and calibre [mm] of vessels between forks, and angles of forks [degrees], in a
    picture (H, W, 3) of `mm` a pixel within a mask: ridges of green's absorbance (Y. Sato et al., 1998)."""
    absorbance = -np.log((rgb[..., 1].astype(float) + 8) / 255)
    ridge = _TOOLS.filters.sato(absorbance, (1.0, 1.5, 2.5, 4.0, 7.0), black_ridges=False)
    vessel = _TOOLS.filters.apply_hysteresis_threshold(ridge, 0.02, 0.045) & inside
    line = _TOOLS.morphology.skeletonize(_TOOLS.morphology.remove_small_objects(vessel, max_size=40))
    forks = line & (convolve(line.astype(int), np.ones((3, 3), int), mode="constant") > 3)
    found = cv2.findContours((line & ~forks).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    found = [piece[:, 0] for piece in found if cv2.arcLength(piece, True) > 8]
    steps = np.array([cv2.arcLength(piece, True) / 2 for piece in found])
    chords = np.array([np.linalg.norm(np.ptp(piece, axis=0)) for piece in found])
    (named, count), angles = label(forks, np.ones((3, 3))), []
    for at in center_of_mass(forks, named, range(1, count + 1)):
        away = [piece - at[::-1] for piece in found]
        ways = [one[np.hypot(*one.T) < 7].mean(axis=0) for one in away if np.hypot(*one.T).min() < 2.5]
        turns = np.sort([np.degrees(np.arctan2(*way)) for way in ways])
        angles += [np.diff([*turns, turns[0] + 360]).min()] if len(ways) == 3 else []
    wide = 2 * mm * distance_transform_edt(vessel)
    calibre = np.array([np.median(wide[piece[:, 1], piece[:, 0]]) for piece in found])
    return {"length": steps * mm, "tortuosity": steps / chords, "angle": np.array(angles), "calibre": calibre}


def measure(photo: Path, outline: str = OUTLINE, width_mm: float = 110.0, frames: int = 12) -> dict[str, Any]:
    """Vessels of `frames` default scenes and of alternate sectors of a photograph, `width_mm` wide.

    `outline`: polygon of its cortex, as shares "x,y x,y ...". Growth was chosen by eye on all of it.
    """
    picture, mm = scaled_photograph(photo, width_mm / 0.08), 0.08
    inside = cv2.erode(outlined(outline, picture.shape[:2]).astype(np.uint8), np.ones((9, 9))) > 0
    y, x = np.indices(inside.shape) - np.argwhere(inside).mean(axis=0)[:, None, None]
    odd = np.floor(np.arctan2(y, x) / (np.pi / 4)) % 2 > 0
    job = Job.model_validate({"seed": 11, "fem": {"instrument": "none"}, "render": {"size": (480, 360)}})
    groups = {"even sectors": [(picture, inside & ~odd, mm)], "odd sectors": [(picture, inside & odd, mm)]}
    rows = []
    for name, shots in {**groups, "rendered": [bare_picture(job, k) for k in range(frames)]}.items():
        every = [statistics(*one) for one in shots]
        row = {key: np.concatenate([one[key] for one in every]) for key in every[0]}
        area, calibre = sum(one[1].sum() * one[2] ** 2 for one in shots), row.pop("calibre")
        density = np.histogram(calibre, _CALIBRES, weights=row["length"])[0] / area
        row = {key: np.quantile(of, (0.25, 0.5, 0.75)).round(3).tolist() for key, of in row.items()}
        rows.append({"vessels": name, **row, "density": density.round(4).tolist()})
    return {"data": status.data(photo), "frames": frames, "width_mm": width_mm, "statistics": rows}


def page(found: Mapping[str, Any]) -> report.Page:
    """Quartiles of lengths, tortuosities and angles, and density by calibre."""
    words = f"Quartiles; length [mm]; angle [degrees]; density [mm/mm2] in bins of calibre {_CALIBRES} mm."
    return report.Page("Vessels", found, [], [report.Section("", found["statistics"])], [words])


STUDY = Study(measure, "render/vessels/vessels.json", page, ("{photo}",), needs=("mesh", "picture"))
