"""A family of one's own, denser and wider vessels, blur and vignette: the job's keys that a fit writes."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from synth.job.schema import Job
from synth.render.anatomy import surface
from synth.render.anatomy.tree import Tree
from synth.render.appearance.look import Look
from synth.render.camera.camera_sensor import Sensor, record


def look(**own: object) -> Look:
    return Look.draw(Job.model_validate({"appearance": {"own": own}}), "healthy", np.random.default_rng(3))


def test_what_is_given_takes_the_familys_place_and_nothing_else_changes() -> None:
    plain, mine = look(), look(crown=[0.5, 0.4, 0.3], arterial=2.0)
    assert mine.crown == pytest.approx(
        np.array([0.5, 0.4, 0.3]) * np.array(plain.crown) / (0.95, 0.79, 0.49), rel=0.1
    )
    assert mine.arterial == 2.0
    same = {name for name in vars(plain) if getattr(plain, name) == getattr(mine, name)}
    assert set(vars(plain)) - same == {"crown", "arterial"}


def test_a_reflectance_is_a_share() -> None:
    with pytest.raises(ValidationError):
        look(crown=[1.4, 0.4, 0.3])
    with pytest.raises(ValidationError):
        look(colour=[0.4, 0.4, 0.3])


def length_inside(tree: Tree, half_mm: float = 12.0) -> float:
    """Length [mm] of the vessels in the middle."""
    child = np.flatnonzero(tree.parent >= 0)
    ends = tree.nodes[child], tree.nodes[tree.parent[child]]
    inside = (np.abs((ends[0] + ends[1]) / 2) < half_mm).all(axis=1)
    return float(np.linalg.norm(ends[0] - ends[1], axis=1)[inside].sum())


def grown(**keys: float) -> surface.Surface:
    job = Job.model_validate({"anatomy": {"vertices": 2000, **keys}})
    return surface.procedural(surface.Relief(4, 12.0, 1.0), job.anatomy)


def test_density_is_length_on_an_area_and_leaves_radii() -> None:
    plain, dense = grown().vessels.arteries, grown(vessel_density=1.6).vessels.arteries
    assert length_inside(dense) / length_inside(plain) == pytest.approx(1.6, rel=0.15)
    assert np.median(dense.radius) == pytest.approx(np.median(plain.radius), rel=0.1)


def test_calibre_is_the_radius_and_leaves_the_web() -> None:
    plain, wide = grown().vessels, grown(vessel_calibre=1.5).vessels
    for name in ("veins", "arteries", "deep"):
        a, b = getattr(plain, name), getattr(wide, name)
        np.testing.assert_array_equal(a.nodes, b.nodes)
        np.testing.assert_allclose(b.radius, 1.5 * a.radius)


def test_the_sensor_is_as_the_job_says() -> None:
    section = Job.model_validate({"sensor": {"vignette": 0.4, "blur_px": 1.2}}).sensor
    drawn = Sensor.draw(section, (1.0, 1.0, 1.0), np.random.default_rng(0))
    assert (drawn.vignette, drawn.blur) == (0.4, 1.2)


def test_blur_widens_an_edge_by_its_own_width() -> None:
    edge = np.zeros((64, 128, 3), np.float32)
    edge[:, 64:] = 0.5
    plain = Sensor(vignette=0, bloom=0, contrast=0, sharpening=0, full_well=1e9, read_noise=0)
    row = record(edge, Sensor(**{**vars(plain), "blur": 2.0}), np.random.default_rng(0))[32, :, 1] / 255
    light = np.where(row <= 0.04045, row / 12.92, ((row + 0.055) / 1.055) ** 2.4) / 0.5
    # A Gaussian's edge rises from 15.9 to 84.1% over two of its standard deviations.
    low, high = np.interp([0.1587, 0.8413], light[54:75], np.arange(54, 75))
    assert (high - low) / 2 == pytest.approx(2.0, rel=0.05)
    sharp = record(edge, plain, np.random.default_rng(0))
    assert sharp[32, :64, 1].max() < 2
    assert sharp[32, 64:, 1].min() > 186
