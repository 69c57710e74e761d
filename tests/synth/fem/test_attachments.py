"""Attachments: what a region holds stays, the rest goes on moving; in the block and in a user's mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from egg_brain import OPENING
from pydantic import ValidationError

from synth.errors import UserError
from synth.fem.mesh import attachments, tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import assemble
from synth.geometry import brain_surface
from synth.job import reader, schema

BALL = {"point": (0.0, 0.0, -14.0), "radius_mm": 5.0, "firm_per_mm": 20.0}
FALX = {"point": (14.0, 0.0, -20.0), "normal": (1.0, 0.0, 0.0), "radius_mm": 18.0, "firm_per_mm": 20.0}


def moved(tets: Tets) -> np.ndarray:
    """(N, 3) mm under an even pull on the opening, upwards and aside."""
    near = np.linalg.norm(tets.points, axis=1) < 7
    outer = np.isin(np.arange(len(near)), tetrahedra.boundary(tets.cells[:, :4], 1))
    return assemble(tets, "linear", 0.4).solve(np.outer(near & outer, (0.5, 0.0, 1.0)))


def compared(free: Tets, held: Tets, region: schema.Attachment, edge_mm: float) -> tuple[float, float]:
    """Motion that is left inside the region and beyond `edge_mm` of it, as parts of the motion without it."""
    before, after = (np.linalg.norm(moved(tets), axis=1) for tets in (free, held))
    inside = attachments.within(region, free.points)
    beyond = ~attachments.within(
        region.model_copy(
            update={
                "radius_mm": region.radius_mm + edge_mm,
                "thickness_mm": region.thickness_mm + 2 * edge_mm,
            }
        ),
        free.points,
    )
    assert inside.sum() >= 3
    return float(after[inside].sum() / before[inside].sum()), float(
        after[beyond].sum() / before[beyond].sum()
    )


@pytest.mark.slow
@pytest.mark.parametrize("given", [BALL, {**FALX, "thickness_mm": 6.0}], ids=["ball", "sheet"])
def test_a_region_of_the_block_is_held_and_the_rest_is_not(given: dict[str, object]) -> None:
    region = schema.Attachment.model_validate(given)
    free = tetrahedra.block(schema.Anatomy(), 2500, 2)
    held = tetrahedra.block(schema.Anatomy(attachments=(region,)), 2500, 2)
    inside, beyond = compared(free, held, region, 8.0)
    assert inside < 0.1
    assert beyond > 0.6


@pytest.mark.slow
def test_a_falx_in_a_users_mesh_stands_in_the_meshs_own_axes(egg: Path) -> None:
    # The opening looks along x, its centre is at x = 32: the middle of the sheet lies 20 mm under it.
    region = schema.Attachment(
        point=(12.0, 0.0, 12.0), normal=(0.0, 0.0, 1.0), radius_mm=18.0, thickness_mm=6.0, firm_per_mm=20.0
    )
    surface = brain_surface.load_brain(egg, OPENING)
    placed = surface.placed((region,))[0]
    np.testing.assert_allclose(np.linalg.norm(placed.point), np.hypot(20, 12), rtol=0.02)
    assert abs(np.dot(placed.normal, (0, 0, 1))) < 1e-12
    free = tetrahedra.from_brain(surface, schema.Anatomy(mesh=egg, craniotomy=OPENING), 1500, 2)
    anatomy = schema.Anatomy(mesh=egg, craniotomy=OPENING, attachments=(region,))
    held = tetrahedra.from_brain(surface, anatomy, 1500, 2)
    inside, beyond = compared(free, held, placed, 8.0)
    assert inside < 0.12
    assert beyond > 0.5


@pytest.mark.parametrize("order", [1, 2])
def test_the_springs_are_the_regions_volume(order: int) -> None:
    """A rigid shift by 1 mm costs firm/thickness times the volume of the sheet."""
    tets = tetrahedra.block(schema.Anatomy(), 1500, order)
    disc = schema.Attachment(point=(0, 0, -25), normal=(0, 0.6, 0.8), radius_mm=15, thickness_mm=4)
    ones = np.ones(len(tets.points))
    total = ones @ (attachments.springs(tets.points, tets.cells, order, (disc,)) @ ones)
    assert total == pytest.approx(disc.firm_per_mm * np.pi * 15**2, rel=0.05)


def test_an_attachment_without_tissue_or_direction_is_refused(tmp_path: Path) -> None:
    nowhere = schema.Attachment(point=(0, 0, 40), radius_mm=5)
    with pytest.raises(UserError, match="number 0 holds no tissue"):
        tetrahedra.block(schema.Anatomy(attachments=(nowhere,)), 300, 1)
    with pytest.raises(ValidationError, match="no length"):
        schema.Attachment(point=(0, 0, 0), radius_mm=5, normal=(0, 0, 0))
    path = tmp_path / "job.yaml"
    path.write_text("anatomy: {attachments: [{point: [0, 0, -20], radius_mm: -1}]}\n")
    with pytest.raises(UserError, match=r"attachments.*radius_mm"):
        reader.load_job(str(path))
    path.write_text("anatomy: {attachments: [{point: [0, 0, -20], radius_mm: 5, normall: [1, 0, 0]}]}\n")
    with pytest.raises(UserError, match="did you mean 'normal'"):
        reader.load_job(str(path))
    path.write_text("anatomy: {attachments: [{radius_mm: 5}]}\n")
    with pytest.raises(UserError, match="point: is missing"):
        reader.load_job(str(path))
