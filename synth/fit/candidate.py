"""Frames of a job that is tried: cortex only, small, the same few anatomies for every try."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from synth.fit.compression import Compression
from synth.fit.statistics import Picture, View, measure
from synth.job.schema import Job
from synth.render.anatomy import surface as anatomy
from synth.render.appearance.light import balance
from synth.render.appearance.look import Look
from synth.render.camera import camera
from synth.render.scene import Studio

_FIELD_MM = 26.0
_SMALLEST_PX, _LARGEST_PX = 160, 480
_INSET_PX = 9  # from the opening's edge


@dataclass(frozen=True)
class Setting:
    """What all frames that are tried have in common."""

    mm_per_px: float
    anatomies: tuple[int, ...]
    compression: Compression

    @property
    def size(self) -> tuple[int, int]:
        """Of a frame, width and height [px]."""
        width = int(np.clip(round(_FIELD_MM / self.mm_per_px), _SMALLEST_PX, _LARGEST_PX)) // 4 * 4
        return width, width * 3 // 4

    def job(self, sections: dict[str, Any]) -> Job:
        """The job with these sections whose frames are tried."""
        width, height = self.size
        field = width * self.mm_per_px
        given = {
            **sections,
            "anatomy": {
                **sections.get("anatomy", {}),
                "vertices": 8000,
                "craniotomy": {"radius_mm": 0.56 * field},
            },
            "render": {"size": [width, height], "field_mm": field, "tilt_deg": [0, 8], "tool": False},
        }
        return Job.model_validate(given)


def render(sections: dict[str, Any], setting: Setting, index: int, *, exact: bool = True) -> View:
    """One frame of a job: of the anatomy `index`, in the look that the job's sections say.

    Args:
        sections: of the job.
        setting: scale and compression.
        index: of the anatomy, view and draws.
        exact: the look is the middle of what a job draws from, so that tries differ by their parameters only.
    """
    job = setting.job(sections)
    family = job.appearance.families[0]
    relief = anatomy.Relief.draw(job.anatomy, np.random.default_rng([index, 0]))
    surface = anatomy.procedural(relief, job.anatomy)
    look = Look.draw(job, family, np.random.default_rng([index, 1]))
    if exact:
        look = _exact(look, job)
    lens = camera.place(camera.View.draw(job.render, np.random.default_rng([index, 2])), job.render)
    studio = Studio(surface, look, lens, job)
    nowhere = np.zeros((2, 3))
    shot = studio.frame(surface.vertices, nowhere, nowhere, seed=index)
    inset = np.ones((_INSET_PX, _INSET_PX), np.uint8)
    usable = cv2.erode(studio.still.tissue.astype(np.uint8), inset) > 0
    return View.whole(setting.compression.apply(shot.rgb), usable, setting.mm_per_px)


def measured(views: Sequence[View]) -> dict[str, float]:
    """Mean statistics of some frames, of those that have one."""
    rows = [measure(view) for view in views]
    found = {}
    for name in rows[0]:
        values = np.array([row[name] for row in rows])
        known = values[np.isfinite(values)]
        found[name] = float(known.mean()) if len(known) else np.nan
    return found


def tiled(views: Sequence[View]) -> Picture:
    """Frames side by side (H, W, 3)."""
    return np.hstack([view.rgb for view in views])


def _exact(look: Look, job: Job) -> Look:
    """The look without what a job varies between sequences."""
    own = job.appearance.own.model_dump(exclude_none=True)
    middle: dict[str, Any] = {}
    for name in ("crown", "flush", "vein", "wine"):
        if name in own:
            middle[name] = tuple(own[name])
    white = balance(look.light.kelvin)
    return replace(look, **middle, sensor=replace(look.sensor, white=white))
