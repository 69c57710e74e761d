"""What surfaces are made of: a user's brain and photograph, families, light in shadows, tissue as volume."""

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import trimesh

from synth.errors import UserError
from synth.job.schema import Anatomy, Appearance, Family, Job, Light, Render
from synth.render.anatomy import surface as anatomy
from synth.render.anatomy import texture, tube
from synth.render.anatomy.surface import Relief, Surface
from synth.render.appearance import light
from synth.render.appearance.light import Lighting
from synth.render.appearance.look import Look
from synth.render.camera import camera
from synth.render.camera.camera import View
from synth.render.scene import Studio

JOB = Job.model_validate(
    {"anatomy": {"vertices": 2500}, "render": {"size": (64, 48), "variant": "scalar_rgb"}}
)
TIPS, SHAFTS = np.zeros((2, 3)), np.array([[0.0, 0, 1], [0.0, 0, 1]])


@pytest.fixture(scope="module")
def brain() -> Surface:
    """An ellipsoid with folds, opened at its top; faces unmerged and wound at random, as users have them."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    folds = 1 + 0.02 * np.cos(9 * ball.vertices[:, 0]) * np.cos(9 * ball.vertices[:, 1])
    points = ball.vertices * folds[:, None] * [45.0, 50.0, 40.0] - [0, 0, 40.0]
    corners = points[ball.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3).astype(np.int32)
    faces[::2] = faces[::2, ::-1]
    return anatomy.from_brain(corners, faces, Relief(3, 12.0, 1.0), JOB.anatomy)


def test_a_users_brain_keeps_its_shape(brain: Surface) -> None:
    x, y, z = brain.vertices.T
    expected = 40 * np.sqrt(1 - (x / 45) ** 2 - (y / 50) ** 2) - 40
    # Folds of 2% and veins of up to a millimetre stand on the ellipsoid.
    assert np.abs(z - expected).max() < 2.5
    assert 0 <= brain.uv.min() < brain.uv.max() <= 1


def test_planar_maps_are_hardly_stretched(brain: Surface) -> None:
    """Seen through an opening a surface needs no unwrapping: L2 stretch of Sander et al. 2001."""
    v, p = brain.vertices[brain.faces], brain.uv[brain.faces].astype(float)
    e, f = v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(e, f), axis=1)
    flat = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], axis=-1)
    map_size = 0.5 * np.abs(np.linalg.det(flat)).sum()
    ds, dt = np.moveaxis(np.einsum("nkc,ncj->njk", np.stack([e, f], -1), np.linalg.inv(flat)), 1, 0)
    squared = 0.5 * ((ds**2).sum(axis=1) + (dt**2).sum(axis=1)) * map_size / area.sum()
    assert np.sqrt((area * squared).sum() / area.sum()) < 1.05


@pytest.mark.slow
def test_a_photograph_is_the_albedo(brain: Surface, tmp_path: Path) -> None:
    picture = np.zeros((60, 90, 3), np.uint8)
    picture[:, :45], picture[:, 45:] = (30, 60, 200), (40, 180, 60)  # red left, green right, as BGR
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), picture)
    look = Look.draw(JOB, "healthy", np.random.default_rng(0))
    coat = texture.cortex(brain, look, 128, path)
    assert coat.albedo[64, 20, 0] > 4 * coat.albedo[64, 20, 1]
    assert coat.albedo[64, 108, 1] > 4 * coat.albedo[64, 108, 0]
    job = JOB.model_copy(update={"appearance": Appearance(photo=path)})
    lens = camera.place(View.draw(job.render, np.random.default_rng(0)), job.render)
    studio = Studio(brain, look, lens, job)
    shot = studio.frame(brain.vertices, TIPS, SHAFTS, 1)
    x = (studio.still.bary[..., None] * brain.vertices[brain.faces[studio.still.face]]).sum(axis=2)[..., 0]
    inside = studio.still.tissue & ~shot.tool
    assert shot.radiance[inside & (x < -2)][:, 0].mean() > shot.radiance[inside & (x < -2)][:, 1].mean()
    assert shot.radiance[inside & (x > 2)][:, 1].mean() > shot.radiance[inside & (x > 2)][:, 0].mean()


def test_a_photograph_that_is_none_is_named(brain: Surface, tmp_path: Path) -> None:
    path = tmp_path / "notes.png"
    path.write_text("no picture")
    with pytest.raises(UserError, match=r"appearance\.photo: .*notes\.png"):
        texture.cortex(brain, Look.draw(JOB, "healthy", np.random.default_rng(0)), 128, path)


def test_families_differ_and_a_specimen_does_not_bleed() -> None:
    looks = {f: [Look.draw(JOB, f, np.random.default_rng(k)) for k in range(20)] for f in get_args(Family)}
    assert len(looks) >= 5
    red = {f: np.mean([look.crown[0] / look.crown[1] for look in drawn]) for f, drawn in looks.items()}
    assert red["pale"] < red["healthy"] < red["hyperaemic"]
    assert max(look.blood for look in looks["calf"]) < 0.05
    assert min(look.blood for look in looks["healthy"]) > 0.2


def test_blood_and_cotton_are_options() -> None:
    job = JOB.model_copy(update={"appearance": Appearance(blood=(0.0, 0.0), cottonoid=1.0)})
    look = Look.draw(job, "healthy", np.random.default_rng(0))
    assert look.blood == 0
    assert look.cottonoid


@pytest.mark.parametrize("tilt", [0.0, 15.0])
def test_the_lamp_is_mirrored_by_the_slope_asked_for(tilt: float) -> None:
    render = Render(tilt_deg=(tilt, tilt))
    lens = camera.place(View.draw(render, np.random.default_rng(2)), render)
    for seed in range(10):
        drawn = Lighting.draw(Light(), np.random.default_rng(seed))
        towards = light.lamps(lens, drawn)[0].position
        half = towards / np.linalg.norm(towards) + lens.centre / np.linalg.norm(lens.centre)
        slope = np.rad2deg(np.arccos(half[2] / np.linalg.norm(half)))
        lean = np.rad2deg(
            np.arccos(towards @ lens.centre / np.linalg.norm(towards) / np.linalg.norm(lens.centre))
        )
        assert lean <= 6.5 + 1e-9, "shadows are long"
        assert slope == pytest.approx(drawn.mirror_deg, abs=1.0) or lean == pytest.approx(6.5)
    asked = Lighting.draw(Light(tilt_deg=(33.0, 33.0)), np.random.default_rng(0))
    towards = light.lamps(lens, asked)[0].position
    angle = np.arccos(towards @ lens.centre / np.linalg.norm(towards) / np.linalg.norm(lens.centre))
    assert np.rad2deg(angle) == pytest.approx(33.0)


def test_the_spot_moves_with_the_microscope_and_is_one_for_both_eyes() -> None:
    render = Render(stereo_mm=24.0)
    lens = camera.place(View.draw(render, np.random.default_rng(2)), render)
    drawn = Lighting.draw(Light(even=(0.3, 0.3)), np.random.default_rng(0))
    right = camera.beside(lens, 24.0)
    field = lens.size[0] * lens.mm_per_px
    axis = lens.centre / np.linalg.norm(lens.centre)
    across = lens.rotation[0]
    for radius, expected in ((0.0, 1.0), (0.29, 1.0), (0.45, 0.75)):
        point = radius * field * across
        assert abs(point @ axis) < 1e-9
        for eye in (lens, right):
            x, y = np.rint(camera.project(eye, point[None])[0]).astype(int)
            found = light.spot(eye, lens, drawn)
            assert found.shape == (lens.size[1], lens.size[0])
            assert found[y, x] == pytest.approx(expected, abs=0.01)


def test_power_drifts_from_the_rest_frame_by_no_more_than_asked() -> None:
    for seed in range(20):
        drawn = Lighting.draw(Light(drift=(0.2, 0.2)), np.random.default_rng(seed))
        gains = [drawn.gain(part) for part in np.linspace(0, 1, 50)]
        assert gains[0] == 1
        assert 0.01 < np.abs(np.array(gains) - 1).max() <= 0.2


@pytest.mark.slow
def test_a_volume_looks_about_like_the_blurred_albedo() -> None:
    """The reference for `subsurface: blur`: brightness within a tenth, channel by channel."""
    seen = []
    for kind in ("blur", "volume"):
        sections = {"subsurface": kind, "size": (32, 24), "spp": 16, "tool": False, "variant": "scalar_rgb"}
        job = Job.model_validate({"anatomy": {"vertices": 2500}, "render": sections})
        surface = anatomy.procedural(Relief.draw(job.anatomy, np.random.default_rng(4)), job.anatomy)
        lens = camera.place(View.draw(job.render, np.random.default_rng(4)), job.render)
        studio = Studio(surface, Look.draw(job, "healthy", np.random.default_rng(4)), lens, job)
        shot = studio.frame(surface.vertices, TIPS, SHAFTS, 1)
        seen.append(np.median(shot.radiance[studio.still.tissue], axis=0))
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.15)


def test_the_film_is_on_few_of_the_crowns_and_on_more_where_highlights_are_many() -> None:
    job = Job(anatomy=Anatomy(vertices=2500))
    surface = anatomy.procedural(Relief.draw(job.anatomy, np.random.default_rng(4)), job.anatomy)
    veins = tube.raster(surface.vessels.veins, 512, surface.extent_mm)
    beside = np.abs(veins[0] - veins[1] - 0.1) < 0.1
    crown = cv2.resize(surface.sulci, (512, 512)) < 0.1
    wet = {}
    for glare in (0.0, 0.5, 1.0):
        lit = Job(light=Light(glare=(glare, glare)))
        look = Look.draw(lit, "healthy", np.random.default_rng(4))
        bare = texture.cortex(surface, look, 512, None).dry
        wet[glare] = float((bare[crown] < 0.97).mean())
        assert (bare[beside] < 0.97).mean() > wet[glare]
    assert wet[0.0] < 0.35 < wet[0.5] < wet[1.0]
