"""Contacts of known force on a block of tissue, and the displacement that they make."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.methods.compliance import TO_CAMERA, Compliance, ElasticBlock, picture

Floats = NDArray[np.float64]


def contacts(
    known: Compliance, count: int, young_kpa: float, tets: int, rng: np.random.Generator
) -> tuple[Floats, list[Floats]]:
    """Random contacts on another mesh than the compliance's.

    20-300 mN within 65 degrees of the normal, pull or push, 3-6 mm in radius, up to 5 mm off the centre.

    Returns:
        (count, 3) forces [mN], camera axes; count fields (P, C) of displacement [mm], C as the compliance's.
    """
    block = ElasticBlock.build(tets)
    seen = block.embed(known.points)
    steps = np.stack(np.meshgrid(np.linspace(-1, 1, 13), np.linspace(-1, 1, 13)), axis=-1).reshape(-1, 2)
    disc = steps[np.hypot(*steps.T) < 1]
    share = (1 - np.square(disc).sum(axis=1)) ** 2
    share /= share.sum()
    forces: list[Floats] = []
    fields: list[Floats] = []
    for _ in range(count):
        radius, at, size = rng.uniform(3, 6), rng.uniform(-5, 5, 2), rng.uniform(20, 300)
        up = rng.uniform(np.cos(np.deg2rad(65)), 1)
        around = rng.uniform(0, 2 * np.pi)
        flat = np.sqrt(1 - up**2)
        way = np.array([flat * np.cos(around), flat * np.sin(around), up * rng.choice([-1, 1])])
        load = block.embed(at + radius * disc).gather(np.outer(share, size * way)) / young_kpa
        moved = block.system.solve(load)
        forces.append(np.asarray(TO_CAMERA @ (size * way)))
        fields.append(picture(seen, moved, len(known.matrix) // len(known.points)))
    return np.array(forces), fields
