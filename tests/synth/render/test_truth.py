"""Ground truth against other implementations on the same geometry."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from synth.geometry.triangles import Shape
from synth.job.schema import AnatomySection, RenderSection
from synth.render import truth
from synth.render.anatomy import surface as anatomy
from synth.render.camera import camera
from synth.render.camera.camera import Camera
from synth.sequence import scenario
from synth.sequence.draw import read_lens

NOTHING = Shape(np.array([[0.0, 0.0, -900.0]] * 3), np.array([[0, 1, 2]], np.int32))


def grow_shape(vertices: int) -> Shape:
    section = AnatomySection(vertices=vertices)
    cortex = anatomy.grow(scenario.draw_relief(section, np.random.default_rng(5)), vertices=vertices)
    return Shape(cortex.vertices, cortex.faces)


def place_camera(**render: object) -> Camera:
    section = RenderSection.model_validate(render)
    return camera.place(scenario.draw_view(section, np.random.default_rng(2)), read_lens(section))


@pytest.fixture(scope="module")
def shape() -> Shape:
    return grow_shape(2500)


@pytest.fixture(scope="module")
def lens() -> Camera:
    return place_camera(size=(96, 72), tilt_deg=20.0, distortion=(-0.3, 0.1, 0.004, -0.003, 0.0))


@pytest.fixture(scope="module")
def rest(shape: Shape, lens: Camera) -> truth.RestFrame:
    return truth.trace_rest(lens, shape, NOTHING)


@pytest.fixture(scope="module")
def moved_shape(shape: Shape) -> Shape:
    """A smooth pull of 2 mm with some sideways motion."""
    x, y, _ = shape.vertices.T
    pull = 2.0 * np.exp(-((x - 1) ** 2 + (y + 2) ** 2) / 18)
    return Shape(shape.vertices + np.stack([0.5 * pull, -0.3 * pull, pull], axis=1), shape.faces)


def test_rays_meet_what_trimesh_meets_even_where_triangles_bow() -> None:
    """Faces of up to some 20 px through a lens 60 mm away that shortens the corner by a tenth."""
    coarse = grow_shape(400)
    close_camera = place_camera(
        size=(320, 240), working_distance_mm=60.0, distortion=(-0.9, 0.8, 0.01, -0.01, 0.0)
    )
    rest = truth.trace_rest(close_camera, coarse, NOTHING)
    pixels = camera.pixel_grid(close_camera.size)[::11]
    rays = camera.rays(close_camera, pixels)
    origins, directions = np.tile(close_camera.centre, (len(pixels), 1)), rays @ close_camera.rotation
    undistorted = (pixels - close_camera.K[:2, 2]) / np.diag(close_camera.K)[:2]
    shift = np.linalg.norm(rays[:, :2] / rays[:, 2:] - undistorted, axis=1) * close_camera.K[0, 0]
    assert shift.max() > 5, "a lens that bends nothing proves nothing"
    mesh = trimesh.Trimesh(coarse.vertices, coarse.faces, process=False)
    locations, ray, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    expected = np.full((len(pixels), 3), np.nan)
    expected[ray] = locations
    corners = coarse.vertices[coarse.faces[rest.face.ravel()[::11]]]
    points = np.einsum("nk,nkc->nc", rest.bary.reshape(-1, 3)[::11], corners)
    points[~rest.tissue.ravel()[::11]] = np.nan
    assert np.isfinite(expected).all(axis=1).sum() > 2000
    np.testing.assert_allclose(points, expected, atol=1e-6)


def test_flow_warps_the_moved_surface_back_to_rest(
    shape: Shape, moved_shape: Shape, lens: Camera, rest: truth.RestFrame
) -> None:
    """The material point of a pixel at rest is the one at the flow's end in the moved frame."""
    now = truth.trace_frame(lens, rest, moved_shape, NOTHING, NOTHING)
    visible = now.visible & rest.tissue
    assert visible.mean() > 0.5
    assert np.linalg.norm(now.flow[visible], axis=1).max() > 3
    pixels = camera.pixel_grid(lens.size).reshape(72, 96, 2)
    ends = pixels[visible] + now.flow[visible]
    directions = camera.rays(lens, ends) @ lens.rotation
    origins = np.tile(lens.centre, (len(ends), 1))
    mesh = trimesh.Trimesh(moved_shape.vertices, moved_shape.faces, process=False)
    locations, ray, triangle = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    bary = trimesh.triangles.points_to_barycentric(
        moved_shape.vertices[moved_shape.faces[triangle]], locations
    )
    material = np.einsum("nk,nkc->nc", bary, shape.vertices[shape.faces[triangle]])
    error = np.linalg.norm(camera.project(lens, material) - pixels[visible][ray], axis=1)
    assert np.median(error) < 1e-4
    assert np.quantile(error, 0.999) < 1e-3


def test_what_hides_a_point_makes_it_invisible(shape: Shape, lens: Camera, rest: truth.RestFrame) -> None:
    corners = np.array([[-4.0, -4.0, 6.0], [4.0, -4.0, 6.0], [4.0, 4.0, 6.0], [-4.0, 4.0, 6.0]])
    plate = Shape(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    now = truth.trace_frame(lens, rest, shape, NOTHING, plate)
    assert 0.02 < now.tool.mean() < 0.3
    # Nothing moved, so a rest pixel is visible just where the plate is not.
    np.testing.assert_array_equal(now.visible, rest.tissue & ~now.tool)
    assert now.depth[now.tool].max() < now.depth[rest.tissue & ~now.tool].max()
    np.testing.assert_allclose(now.flow[rest.tissue], 0, atol=1e-5)


@pytest.mark.parametrize("turn", range(3))
def test_a_triangle_with_a_corner_behind_the_lens_is_dropped(lens: Camera, turn: int) -> None:
    """Whichever of the three it is; the other two are in the picture, where rays would meet NaN."""
    directions = camera.rays(lens, camera.pixel_grid(lens.size))
    corner_rays = directions.reshape(72, 96, 3)[[10, 60], [12, 80]]
    corners = np.concatenate([80.0 * corner_rays / corner_rays[:, 2:], [[0.0, 6.0, -3.0]]])
    faces = np.array([np.roll([0, 1, 2], turn)], np.int32)
    triangle = Shape((corners - lens.translation) @ lens.rotation, faces)
    hits = truth.ProjectedScene.of(lens, triangle).cast(None, directions)
    assert (hits.face < 0).all()
    assert np.isinf(hits.along).all()


def test_areas_of_pixels_add_up_to_the_surfaces(shape: Shape) -> None:
    rest = truth.trace_rest(place_camera(size=(320, 240), field_mm=60.0, tilt_deg=20.0), shape, NOTHING)
    mesh = trimesh.Trimesh(*shape, process=False)
    assert rest.area.sum() == pytest.approx(mesh.area, rel=5e-3)


def test_a_camera_that_moves_is_part_of_the_flow(shape: Shape, lens: Camera, rest: truth.RestFrame) -> None:
    later_lens = replace(lens, translation=lens.translation + np.array([0.5, 0.0, 0.0]))
    now = truth.trace_frame(later_lens, rest, shape, NOTHING, NOTHING)
    expected = 0.5 * lens.K[0, 0] / lens.translation[2]
    assert np.median(now.flow[rest.tissue][:, 0]) == pytest.approx(expected, rel=0.02)


def test_motion_lands_where_opencv_projects_it(
    moved_shape: Shape, lens: Camera, rest: truth.RestFrame
) -> None:
    now = truth.trace_frame(lens, rest, moved_shape, NOTHING, NOTHING)
    tissue = rest.tissue
    points = rest.points.reshape(*tissue.shape, 3)[tissue] + now.motion[tissue]
    projections = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.K, lens.distortion)[0][:, 0]
    pixels = camera.pixel_grid(lens.size).reshape(*tissue.shape, 2)[tissue]
    np.testing.assert_allclose(projections - pixels, now.flow[tissue], atol=2e-4)
    assert np.abs(now.motion[tissue][:, 2]).max() > 1.0
    assert not now.motion[~tissue].any()
