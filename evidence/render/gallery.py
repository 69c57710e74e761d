"""Images of the gallery: families, instruments, lights, cameras and scenery side by side."""

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from evidence import report
from evidence.study import Study
from synth.arrays import Pixels
from synth.job.schema import Family, Job
from synth.publish.contact_sheet import poised
from synth.render.scene import SceneState
from synth.sequence import scenario
from synth.sequence.scene import at_rest
from synth.tune.search import changed

Settings = dict[str, Any]  # values of a job's dotted keys

_GESTURES: dict[str, str] = {
    "forceps": "pull",
    "bayonet": "grasp",
    "dissector": "push",
    "suction": "tap",
    "spatula": "retract",
    "probe": "slide",
}
_LIGHTS: dict[str, Settings] = {
    "few highlights": {"light.glare": 0.0},
    "many highlights": {"light.glare": 0.8},
    "tilted lamp": {"light.tilt_deg": 30.0, "light.main": 0.9},
    "narrow spot": {"light.even": 0.22},
}
_CAMERAS: dict[str, Settings] = {
    "default": {},
    "noisy": {"sensor.full_well": 900.0, "sensor.read_noise": 25.0, "sensor.sharpening": 1.2},
    "soft": {"sensor.blur_px": 1.2},
    "wide": {"render.field_mm": 46.0, "render.tilt_deg": 28.0, "render.distortion": (-0.25, 0, 0, 0, 0)},
}
_SCENERY: dict[str, str] = {
    "bone": "forceps",
    "drape": "dissector",
    "cottonoid": "suction",
    "retractor": "bayonet",
}
_CAPTION_PX = 15


def measure(out: Path = report.CHECKOUT / "docs", seed: int = 7, width: int = 144, quality: int = 46) -> None:
    """Draws families x instruments and lights x cameras as the images of docs/gallery.md.

    `width`: of a tile [px]; `quality`: of WebP.
    """
    size = (width, width * 3 // 4)
    families = [
        [_tile({"appearance.families": (family,)}, kind, size, seed + row, f"{family}, {kind}")
         for kind in _GESTURES]
        for row, family in enumerate(get_args(Family))
    ]  # fmt: skip
    views = [
        [_tile(lamp | lens, "forceps", size, seed, f"{lit}; {name}") for name, lens in _CAMERAS.items()]
        for lit, lamp in _LIGHTS.items()
    ]
    around = [
        _tile({"render.scenery": (part,)}, kind, size, seed + 3, part) for part, kind in _SCENERY.items()
    ]
    out.mkdir(parents=True, exist_ok=True)
    for name, rows in (("gallery-appearances", families), ("gallery-views", [*views, around])):
        picture = np.vstack([np.hstack(row) for row in rows])
        cv2.imwrite(str(out / f"{name}.webp"), picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])


def _tile(settings: Settings, kind: str, size: tuple[int, int], seed: int, caption: str) -> Pixels:
    """One frame before its load, below its caption."""
    usual = {"render.size": size, "render.spp": 16, "anatomy.vertices": 20_000}
    job = changed(
        Job(seed=seed), usual | {"fem.gestures": (_GESTURES[kind],), "fem.instrument": (kind,)} | settings
    )
    rest = at_rest(job)
    case = rest.scenario
    appearance = replace(case.appearance, scenery=job.render.scenery)
    scene = replace(rest, scenario=replace(case, appearance=appearance, gestures=case.gestures[:1]))
    state = SceneState(rest.surface.vertices, *poised(case.gestures[0], rest.surface))
    shot = scene.renderer.render(state, scenario.frame_seeds(job, 0)[0])
    band = np.full((_CAPTION_PX, size[0], 3), 255, np.uint8)
    cv2.putText(band, caption, (3, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.34, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack([band, shot.rgb])


STUDY = Study(measure)
