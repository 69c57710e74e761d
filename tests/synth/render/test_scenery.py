"""What lies about the opening hides tissue, in truth as in pictures, and is no tissue and no instrument."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_run import in_process

from synth.checks import verify
from synth.job.schema import Anatomy, Job, Render
from synth.render import instrument
from synth.render.anatomy import rim, scenery
from synth.render.anatomy import surface as anatomy
from synth.render.anatomy.surface import Relief
from synth.render.appearance.look import Look
from synth.render.camera import camera
from synth.render.camera.camera import View
from synth.render.scene import Studio
from synth.sequence import pipeline

PARTS = ("retractor", "cottonoid", "bone", "drape")
TIPS = np.array([[-1.0, 1.0, 0.2], [1.2, 1.4, 0.2]])
SHAFTS = np.array([[0.6, 0.3, 0.74], [0.6, 0.3, 0.74]])


def studio(parts: tuple[str, ...], tool: bool = False) -> tuple[Studio, np.ndarray]:
    render = {"size": (96, 72), "variant": "scalar_rgb", "tool": tool, "scenery": parts}
    job = Job(anatomy=Anatomy(vertices=2500), render=Render.model_validate(render))
    surface = anatomy.procedural(Relief.draw(job.anatomy, np.random.default_rng(4)), job.anatomy)
    view = View.draw(job.render, np.random.default_rng(4))
    look = replace(Look.draw(job, "healthy", np.random.default_rng(4)), scenery=parts)
    return Studio(surface, look, camera.place(view, job.render), job), surface.vertices


@pytest.fixture(scope="module")
def bare() -> Studio:
    return studio(())[0]


@pytest.mark.parametrize("part", ["retractor", "cottonoid"])
def test_what_reaches_into_the_opening_takes_tissue_away(bare: Studio, part: str) -> None:
    ours, vertices = studio((part,))
    there, without = ours.still, bare.still
    assert not (there.tissue & ~without.tissue).any()
    hidden = without.tissue & ~there.tissue
    assert 0.005 < hidden.sum() / without.tissue.sum() < 0.3
    assert (there.area[hidden] == 0).all()
    assert (there.area[there.tissue] == without.area[there.tissue]).all()
    assert (ours.traction(np.ones_like(vertices))[hidden] == 0).all()


@pytest.mark.parametrize("part", ["bone", "drape"])
def test_what_lies_outside_leaves_tissue_as_it_is(bare: Studio, part: str) -> None:
    ours, _ = studio((part,))
    assert (ours.still.tissue == bare.still.tissue).all()
    assert (ours.rim.vertices[:, 2] - bare.rim.vertices[:, 2]).max() > 0.8


@pytest.mark.slow
def test_pictures_and_truth_have_it_in_the_same_place() -> None:
    """Its pixels differ from those of a scene without it, and tissue that goes under it is not seen."""
    ours, vertices = studio(("retractor", "cottonoid"))
    plain, _ = studio(())
    one, other = ours.frame(vertices, TIPS, SHAFTS, 3), plain.frame(vertices, TIPS, SHAFTS, 3)
    changed = np.abs(one.radiance - other.radiance).max(axis=2) > 0.05
    hidden = plain.still.tissue & ~ours.still.tissue
    assert changed[hidden].mean() > 0.8
    assert not one.tool.any()
    assert not (one.glare & hidden).any()
    pixel = ours.still.scale_mm_per_px
    # Aside and into the brain: scenery stays where it is, and tissue that rises would come through it.
    aside = vertices + ours.camera.rotation[0] * 6 * pixel - np.array([0, 0, 1.5])
    moved = ours.frame(aside, TIPS, SHAFTS, 4)
    rows, columns = np.nonzero(ours.still.tissue)
    x = np.rint(columns + moved.flow[rows, columns, 0]).astype(int)
    y = np.rint(rows + moved.flow[rows, columns, 1]).astype(int)
    within = (x > 0) & (x < 95) & (y > 0) & (y < 71)
    under = np.zeros(len(rows), bool)
    # Well inside what hides: its outline moves with the camera's height over it.
    core = (
        hidden
        & np.roll(hidden, 1, 0)
        & np.roll(hidden, -1, 0)
        & np.roll(hidden, 1, 1)
        & np.roll(hidden, -1, 1)
    )
    under[within] = core[y[within], x[within]]
    assert under.sum() > 10
    assert moved.visible[rows, columns][under].mean() < 0.05


def test_each_part_is_in_three_of_four_sequences_and_changes_nothing_else() -> None:
    with_all = Job(render=Render(scenery=PARTS))
    shown: list[str] = []
    for seed in range(300):
        look = Look.draw(with_all, "healthy", np.random.default_rng(seed))
        assert replace(look, scenery=()) == Look.draw(Job(), "healthy", np.random.default_rng(seed))
        shown += look.scenery
    for part in PARTS:
        assert shown.count(part) / 300 == pytest.approx(0.75, abs=0.1)


def test_nobody_sews_on_a_bench() -> None:
    job = Job(anatomy=Anatomy(vertices=2500))
    surface = anatomy.procedural(Relief.draw(job.anatomy, np.random.default_rng(4)), job.anatomy)
    held = {
        family: len(rim.build(surface, 12.0, Look.draw(job, family, np.random.default_rng(4)), 0.05).stitches)
        for family in ("healthy", "calf")
    }
    assert held["healthy"] >= 4
    assert held["calf"] == 0


def test_the_cut_edge_slopes_to_the_tissue() -> None:
    """An upright wall is seen on edge: it would be a black line of one pixel around the opening."""
    job = Job(anatomy=Anatomy(vertices=2500))
    surface = anatomy.procedural(Relief.draw(job.anatomy, np.random.default_rng(4)), job.anatomy)
    made = rim.build(surface, 12.0, Look.draw(job, "healthy", np.random.default_rng(4)), 0.05)
    rings = made.vertices[: len(made.edge) * (len(made.vertices) // len(made.edge))].reshape(
        len(made.edge), -1, 3
    )
    out = np.hypot(rings[..., 0], rings[..., 1])
    rise, run = np.diff(rings[:, 1:5, 2], axis=1), np.diff(out[:, 1:5], axis=1)
    assert np.degrees(np.arctan2(rise, run)).max() < 75  # from the tissue on; what is under it is upright


def test_dural_vessels_keep_to_the_dura_and_branch() -> None:
    edge = np.full(320, 12.0)
    for seed in range(5):
        tree = scenery.dural_vessels(edge, np.random.default_rng(seed))
        radius = np.linalg.norm(tree.nodes, axis=1)
        assert (np.abs(radius - 16) < 8).all()
        assert (tree.parent < np.arange(len(tree.parent))).all()
        assert (np.bincount(tree.parent[tree.parent >= 0]) > 1).any()
        assert tree.radius.min() > 0


def test_the_film_climbs_where_a_tip_touches() -> None:
    grid = np.stack([*np.meshgrid(np.linspace(-5, 5, 41), np.linspace(-5, 5, 41)), np.zeros((41, 41))], -1)
    points = grid.reshape(-1, 3)
    made = instrument.build(["forceps"])
    ends = np.array([[-2.0, 0, 0], [2.0, 0, 0]])
    height = instrument.film(made, ends, points).reshape(41, 41)
    assert height[20, 12] == height[20, 28] == height.max()
    assert 0.1 < height.max() < 0.5
    assert height[20, 20] < 0.1 * height.max()
    assert instrument.film(made, ends + np.array([0, 0, 8.0]), points).max() < 1e-3


@pytest.mark.slow
def test_a_dataset_with_scenery_passes_its_checks(tmp_path: Path) -> None:
    job = Job.model_validate(
        {
            "seed": 5,
            "sequences": 2,
            "frames": 4,
            "anatomy": {"vertices": 6400},
            "fem": {"tets": 600},
            "render": {"size": (160, 120), "scenery": PARTS},
            "flow": {"backend": "ideal"},
        }
    )
    out = tmp_path / "out"
    in_process(job, out, pipeline.render_sequence)
    report = verify.verify_dataset(out)
    assert [check.failures for check in report.checks if not check.good] == []
    assert report.sequences == 2
