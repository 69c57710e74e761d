"""A user's brain and photograph as surface and albedo, and the light on it."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synth.geometry.triangles import Shape
from synth.job.schema import Job, LightSection, RenderSection
from synth.render.anatomy import surface as anatomy
from synth.render.anatomy import texture
from synth.render.anatomy.surface import CortexSurface, Relief
from synth.render.appearance import light
from synth.render.camera import camera
from synth.sequence import scenario
from synth.sequence.draw import read_lens

JOB = Job.model_validate({"anatomy": {"vertices": 2500}, "render": {"size": (64, 48)}})


@pytest.fixture(scope="module")
def brain() -> CortexSurface:
    """An ellipsoid with folds, opened at its top; faces unmerged and wound at random, as users have them."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    folds = 1 + 0.02 * np.cos(9 * ball.vertices[:, 0]) * np.cos(9 * ball.vertices[:, 1])
    points = ball.vertices * folds[:, None] * [45.0, 50.0, 40.0] - [0, 0, 40.0]
    corners = points[ball.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3).astype(np.int32)
    faces[::2] = faces[::2, ::-1]
    return anatomy.grow(Relief(3, 12.0, 1.0), vertices=2500, brain=Shape(corners, faces))


def test_a_users_brain_keeps_its_shape(brain: CortexSurface) -> None:
    x, y, z = brain.vertices.T
    expected = 40 * np.sqrt(1 - (x / 45) ** 2 - (y / 50) ** 2) - 40
    # Folds of 2% and veins of up to a millimetre stand on the ellipsoid.
    assert np.abs(z - expected).max() < 2.5
    assert 0 <= brain.uv.min() < brain.uv.max() <= 1


def test_a_photograph_is_the_albedo(brain: CortexSurface, tmp_path: Path) -> None:
    picture = np.zeros((60, 90, 3), np.uint8)
    picture[:, :45], picture[:, 45:] = (30, 60, 200), (40, 180, 60)  # red left, green right, as BGR
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), picture)
    appearance = scenario.draw_appearance(JOB, "healthy", np.random.default_rng(0))
    coat = texture.cortex(brain, appearance, 128, path)
    assert coat.albedo[64, 20, 0] > 4 * coat.albedo[64, 20, 1]
    assert coat.albedo[64, 108, 1] > 4 * coat.albedo[64, 108, 0]


def test_the_spot_moves_with_the_microscope_and_is_the_same_for_both_cameras() -> None:
    render = RenderSection(stereo_mm=24.0)
    lens = camera.place(scenario.draw_view(render, np.random.default_rng(2)), read_lens(render))
    illumination = scenario.draw_light(LightSection(even=(0.3, 0.3)), np.random.default_rng(0))
    right = camera.right_camera(lens, 24.0)
    field = lens.size[0] * lens.mm_per_px
    axis = lens.centre / np.linalg.norm(lens.centre)
    image_axis = lens.rotation[0]
    peak = 1.25  # brightest of a spot smaller than the opening
    for radius, share in ((0.0, 1.0), (0.3, 2 / 3), (0.45, 1 / (1 + 0.5 * 1.5**4))):
        point = radius * field * image_axis
        assert abs(point @ axis) < 1e-9
        for view in (lens, right):
            x, y = np.rint(camera.project(view, point[None])[0]).astype(int)
            spot = light.spot(view, lens, illumination.even)
            assert spot.shape == (lens.size[1], lens.size[0])
            assert spot[y, x] == pytest.approx(peak * share, abs=0.01)


def test_a_spot_of_any_usual_size_leaves_the_opening_its_mean_light() -> None:
    render = RenderSection()
    lens = camera.place(scenario.draw_view(render, np.random.default_rng(2)), read_lens(render))
    rows, columns = np.mgrid[: lens.size[1], : lens.size[0]]
    distance = np.hypot(columns - lens.K[0, 2], rows - lens.K[1, 2]) / lens.size[0]
    for even in (0.35, 0.5, np.inf):
        assert light.spot(lens, lens, even)[distance < 0.37].mean() == pytest.approx(1, abs=0.01)
