"""Draws the images of the gallery: families, instruments, lights, cameras, scenery and loads side by side."""

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from synth.arrays import Pixels
from synth.job.reader import load_job
from synth.job.schema import Family, Job
from synth.publish.contact_sheet import pose_touching
from synth.render.idle import with_idle
from synth.render.scene import SceneState
from synth.sequence.rest_scene import RestScene, at_rest
from synth.sequence.simulation import simulate
from synth.tune.search import change_job

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
    "soft": {"sensor.blur_px": 5.0},
    "wide": {"render.field_mm": 46.0, "render.tilt_deg": 28.0, "render.distortion": (-0.25, 0, 0, 0, 0)},
}
_SCENERY: dict[str, str] = {
    "bone": "forceps",
    "drape": "dissector",
    "retractor": "bayonet",
    "bone, drape, clips": "suction",
}
_LOADS: dict[str, Settings] = {
    "retraction of 5 mm": {
        "fem.gestures": ("retract",),
        "fem.instrument": ("spatula",),
        "fem.travel_mm": 5.0,
    },
    "grasp of 0.3 N": {
        "fem.gestures": ("grasp",),
        "fem.instrument": ("forceps",),
        "fem.travel_mm": None,
        "fem.force_mn": 300.0,
    },
}
_RECIPES = "endoscope", "ex-vivo-calf", "in-vivo", "paper", "stereo"
_CAPTION_PX = 24


def draw(out: Path = Path(__file__).parent, seed: int = 7, width: int = 640, quality: int = 50) -> None:
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
        _tile({"render.scenery": tuple(parts.split(", "))}, kind, size, seed + 3, parts)
        for parts, kind in _SCENERY.items()
    ]
    out.mkdir(parents=True, exist_ok=True)
    for name, rows in (("gallery-appearances", families), ("gallery-views", [*views, around])):
        _save(out / f"{name}.webp", rows, quality)
    _save(out / "gallery-loads.webp", [_load(settings, name) for name, settings in _LOADS.items()], quality)
    job = change_job(load_job("randomized"), {"render.stereo_mm": 0, "store.without": (), "sequences": 48})
    tiles = [_ready(at_rest(job, index)) for index in range(48)]
    _save(out / "gallery-randomized.webp", [tiles[k : k + 8] for k in range(0, 48, 8)], quality)
    for name in _RECIPES:
        cv2.imwrite(str(out / f"recipes/{name}.jpg"), _recipe(name)[..., ::-1])


def _tile(settings: Settings, kind: str, size: tuple[int, int], seed: int, caption: str) -> Pixels:
    """One frame before its load, below its caption."""
    defaults = {"render.size": size, "render.spp": 16, "anatomy.vertices": 20_000, "render.scenery": ()}
    job = change_job(
        Job(seed=seed), defaults | {"fem.gestures": (_GESTURES[kind],), "fem.instrument": (kind,)} | settings
    )
    rest = at_rest(job)
    case = rest.scenario
    appearance = replace(case.appearance, scenery=job.render.scenery)
    case = replace(case, appearance=appearance, gestures=case.gestures[:1])
    shot = _ready(replace(rest, draw=replace(rest.draw, scenario=case)))
    return _with_caption(shot, caption)


def _load(settings: Settings, name: str, frames: int = 25) -> list[Pixels]:
    """Frames of a clinical load at 960 × 720: at rest, at a third, at two thirds and at its largest force."""
    defaults: Settings = {"frames": frames, "fps": frames / 3, "render.size": (960, 720), "render.spp": 16}
    fem = {"fem.young_kpa": 3.0, "fem.membrane.probability": 0.0, "render.scenery": ()}
    scene = simulate(change_job(load_job("clinical"), defaults | fem | settings))
    force = np.linalg.norm(scene.force, axis=-1)
    top = scene.strongest
    rising = [int(np.argmin(np.abs(force[: top + 1] - share * force[top]))) for share in (0, 1 / 3, 2 / 3, 1)]
    return [_with_caption(scene.frame(t).rgb, f"{name}: {force[t]:.0f} mN") for t in rising]


def _recipe(name: str) -> Pixels:
    """The frame of the largest force of a job's first sequence, of two cameras side by side."""
    settings: Settings = {"frames": 12, "seed": 2, "render.size": (256, 192), "anatomy.vertices": 20_000}
    scene = simulate(change_job(load_job(name), settings))
    shot = scene.frame(scene.strongest)
    return shot.rgb if shot.rgb_right is None else np.hstack([shot.rgb, shot.rgb_right])


def _with_caption(shot: Pixels, caption: str) -> Pixels:
    band = np.full((_CAPTION_PX, shot.shape[1], 3), 255, np.uint8)
    cv2.putText(band, caption, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack([band, shot])


def _ready(scene: RestScene) -> Pixels:
    """The picture of a scene whose instruments touch the tissue."""
    case, surface = scene.scenario, scene.surface
    ends, shafts = zip(*(pose_touching(gesture, surface) for gesture in case.gestures), strict=True)
    poses = with_idle(case.idle, 0.0, np.concatenate(ends), np.concatenate(shafts))
    return scene.renderer.render(SceneState(surface.vertices, *poses), scene.draw.frame_seeds[0]).rgb


def _save(file: Path, rows: list[list[Pixels]], quality: int) -> None:
    picture = np.vstack([np.hstack(row) for row in rows])
    cv2.imwrite(str(file), picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])


if __name__ == "__main__":
    draw()
