"""Attachments: what a region holds stays, the rest goes on moving; in the block and in a user's mesh."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from synth.errors import UserError
from synth.fem.mesh import attachments, tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import assemble
from synth.job import schema

FALX = {
    "point": (14.0, 0.0, -20.0),
    "normal": (1.0, 0.0, 0.0),
    "radius_mm": 18.0,
    "thickness_mm": 6.0,
}


def moved(tets: Tets) -> np.ndarray:
    """(N, 3) mm under an even pull on the opening, upwards and aside."""
    near = np.linalg.norm(tets.points, axis=1) < 7
    outer = np.isin(np.arange(len(near)), tetrahedra.boundary(tets.cells[:, :4]))
    return assemble(tets, "linear", 0.4).solve(np.outer(near & outer, (0.5, 0.0, 1.0)))


def compared(free: Tets, held: Tets, region: schema.AttachmentSection, edge_mm: float) -> tuple[float, float]:
    """Motion that is left inside the region and beyond `edge_mm` of it, as parts of the motion without it."""
    before, after = (np.linalg.norm(moved(tets), axis=1) for tets in (free, held))
    inside = attachments.within(region, free.points)
    wide = {"radius_mm": region.radius_mm + edge_mm, "thickness_mm": region.thickness_mm + 2 * edge_mm}
    beyond = ~attachments.within(region.model_copy(update=wide), free.points)
    assert inside.sum() >= 3
    left = [float(after[at].sum() / before[at].sum()) for at in (inside, beyond)]
    return left[0], left[1]


@pytest.mark.slow
def test_a_region_of_the_block_is_held_and_the_rest_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attachments, "_FIRM_PER_MM", 20.0)
    region = schema.AttachmentSection.model_validate(FALX)
    free = tetrahedra.block(schema.AnatomySection(), 2500)
    held = tetrahedra.block(schema.AnatomySection(attachments=(region,)), 2500)
    inside, beyond = compared(free, held, region, 8.0)
    assert inside < 0.1
    assert beyond > 0.6


def test_the_springs_are_the_regions_volume() -> None:
    """A rigid shift by 1 mm costs firm/thickness times the volume of the sheet."""
    tets = tetrahedra.block(schema.AnatomySection(), 1500)
    disc = schema.AttachmentSection(point=(0, 0, -25), normal=(0, 0.6, 0.8), radius_mm=15, thickness_mm=4)
    ones = np.ones(len(tets.points))
    total = ones @ (attachments.springs(tets.points, tets.cells, (disc,)) @ ones)
    assert total == pytest.approx(2 * np.pi * 15**2, rel=0.05)


def test_an_attachment_without_tissue_or_direction_is_refused() -> None:
    nowhere = schema.AttachmentSection(point=(0, 0, 40), radius_mm=5)
    with pytest.raises(UserError, match="attachments"):
        tetrahedra.block(schema.AnatomySection(attachments=(nowhere,)), 300)
    for wrong in ({"normal": (0, 0, 0)}, {"radius_mm": -1}):
        with pytest.raises(ValidationError):
            schema.AttachmentSection.model_validate({"point": (0, 0, -20), "radius_mm": 5} | wrong)
