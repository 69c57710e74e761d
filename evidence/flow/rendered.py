"""Rendered pairs for the flow benchmark: our own wet cortex, pulled by a field given in closed form.

The pull isn't the FEM's, so that its size can be asked for and flow is measured apart from physics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evidence.flow.scenes import Pair
from synth.flow import mask
from synth.job.schema import Job
from synth.render.anatomy import surface as anatomy
from synth.render.camera import camera
from synth.render.scene import Shot, Studio
from synth.sequence import scenario


@dataclass(frozen=True)
class Wet:
    """What is rendered."""

    size: tuple[int, int] = (640, 480)
    """Width, height [px]."""
    spp: int = 4
    peak_px: float = 7.0
    """Largest displacement in the picture [px]."""
    tool: bool = False
    """Show the forceps at the contact."""
    glare: float | None = None
    """The job's `light.glare`, 0 to 1; None: as the default job has it."""


@dataclass(frozen=True)
class WetPair:
    """A rendered pair with its masks, exact and automatic."""

    pair: Pair
    """With exact masks."""
    tissue: NDArray[np.bool_]
    """(H, W), rest frame."""
    visible: NDArray[np.bool_]
    """(H, W): the rest pixel's material point is seen now."""
    rest_glare: NDArray[np.bool_]
    """(H, W), by threshold, rest frame."""
    now_glare: NDArray[np.bool_]
    """(H, W), by threshold, now."""
    share: float
    """Of the tissue's pixels in the now frame, taken for glare by threshold."""
    mm_per_px: float
    """At the craniotomy's centre."""


def pairs(wet: Wet, count: int, seed: int) -> Iterator[WetPair]:
    """`count` rendered pairs, each with its own anatomy, look, view and pull."""
    job = Job.model_validate(
        {
            "seed": seed,
            "sequences": count,
            "frames": 2,
            "render": {"size": wet.size, "spp": wet.spp, "tool": wet.tool},
            "light": {} if wet.glare is None else {"glare": wet.glare},
        }
    )
    for index in range(count):
        yield _pair(job, index, wet)


def _pair(job: Job, index: int, wet: Wet) -> WetPair:
    case = scenario.draw(job, index)
    view = camera.place(case.view, job.render)
    rng = np.random.default_rng([job.seed, index])
    surface = anatomy.procedural(case.relief, job.anatomy)
    rest = surface.vertices
    dimple = _dimple(rest, rng, job.anatomy.craniotomy.radius_mm)
    held = int(np.argmax(np.linalg.norm(dimple, axis=1)))
    lean = rng.uniform(0, 2 * np.pi)
    shaft = np.array([np.cos(lean), np.sin(lean), 1.0]) / np.sqrt(2)
    side = np.array([-np.sin(lean), np.cos(lean), 0.0])
    tips, shafts = rest[held] + np.stack([side, -side]), np.stack([shaft, shaft])
    seeds = scenario.frame_seeds(job, index)
    studio = Studio(surface, case.look, view, job)

    def shoot(amount: float, away_mm: float, seed: int) -> Shot:
        return studio.frame(
            rest + amount * dimple, tips + amount * dimple[held] + away_mm * shafts, shafts, seed
        )

    before = shoot(0.0, 60.0, seeds[0])
    amount = wet.peak_px * view.mm_per_px
    # Perspective and tilt: the picture's peak is not the world's.
    seen = shoot(amount, 60.0, seeds[1]).flow
    amount *= wet.peak_px / float(np.hypot(seen[..., 0], seen[..., 1]).max())
    now = shoot(amount, 0.0, seeds[1])
    tissue = studio.still.tissue
    length = np.hypot(now.flow[..., 0], now.flow[..., 1])
    automatic = mask.glare(now.rgb)
    return WetPair(
        pair=Pair(
            rest=before.rgb,
            now=now.rgb,
            flow=now.flow,
            rest_usable=tissue & ~before.glare,
            now_usable=~(now.glare | now.tool),
            tool=now.tool,
            glare=now.glare,
            hidden=tissue & ~now.visible,
            contact=tissue & (length > 0.7 * length.max()),
            inside=tissue,
        ),
        tissue=tissue,
        visible=now.visible,
        rest_glare=mask.glare(before.rgb),
        now_glare=automatic,
        share=float(automatic[tissue].mean()),
        mm_per_px=view.mm_per_px,
    )


def _dimple(rest: NDArray[np.float64], rng: np.random.Generator, radius_mm: float) -> NDArray[np.float64]:
    """Displacement (V, 3) of a pull near the middle, largest 1: outwards and sideways, 1/r beyond."""
    towards, lift = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.6)
    away = rest[:, :2] - rng.uniform(-3, 3, 2)
    distance = np.linalg.norm(away, axis=1)
    rim = np.clip(1.15 - np.linalg.norm(rest[:, :2], axis=1) / radius_mm, 0, 0.5) / 0.5
    size = rim**2 * (3 - 2 * rim) / np.sqrt(1 + (distance / 3.0) ** 2)
    way = np.array([np.cos(towards), np.sin(towards), lift])
    field = size[:, None] * way
    field[:, :2] -= 0.05 * (size * np.exp(-((distance / 4.0) ** 2)))[:, None] * away
    return np.asarray(field / np.linalg.norm(field, axis=1).max(), np.float64)
