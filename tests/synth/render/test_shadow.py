"""Shadows of instruments against trimesh's rays in double precision, and against a half plane's."""

import numpy as np
import pytest
import trimesh

from synth.geometry.triangles import Shape, grid_faces, join_shapes, normals
from synth.render import instrument, truth
from synth.render.camera import camera
from synth.render.materials import Lamp
from synth.render.shadow import shadow_map, window

SIZE = (48, 36)
LENS = camera.place(camera.CameraView(24.0, 150.0, 10.0, 40.0, 20.0, 0.0), camera.Lens(SIZE))
RAYS = camera.rays(LENS, camera.pixel_grid(SIZE))


def plate(left: float, right: float, z: float) -> Shape:
    """A level rectangle, 80 mm long across x."""
    corners = np.array([[left, -40.0, z], [right, -40.0, z], [left, 40.0, z], [right, 40.0, z]])
    return Shape(corners, grid_faces(2, 2).reshape(-1, 3))


def cast_shadows(lamps: list[Lamp], *shapes: Shape) -> tuple[truth.Hits, np.ndarray]:
    hits = truth.ProjectedScene.of(LENS, join_shapes(*shapes)).cast(None, RAYS)
    return hits, shadow_map(hits, shapes, lamps, SIZE).ravel()


def test_shadows_are_those_of_trimeshs_rays() -> None:
    """On a bump, under a rim's edge and two instruments, by a lamp above and one aside."""
    lamps = [Lamp(np.array([30.0, -20.0, 140.0]), np.zeros(3), 9.0, np.array([3.0, 2.0, 1.0]))]
    lamps.append(Lamp(np.array([-90.0, 10.0, 60.0]), np.array([1.0, 2.0, 0.0]), 4.0, np.full(3, 0.7)))
    tools = instrument.build([("forceps", 3.0), ("probe", 4.0)], None, np.random.default_rng(0))  # type: ignore[arg-type]
    assert tools is not None
    tips = np.array([[-1.0, 1.0, 3.0], [1.2, 1.4, 3.0], [-5.0, -4.0, 2.0], [-5.0, -4.0, 2.0]])
    posed_tools = tools.pose(tips, np.repeat([[0.6, 0.3, 0.74], [-0.6, 0.3, 0.74]], 2, axis=0))
    assert np.array_equal(tools.owner, posed_tools.faces[:, 0] >= 2 * len(tools.parts[0][0].profile))
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-20, 20, 41)] * 2))
    bump = Shape(np.stack([x, y, 3 * np.exp(-(x**2 + y**2) / 20)], 1), grid_faces(41, 41).reshape(-1, 3))
    shapes = bump, plate(-30.0, -7.0, 4.0), posed_tools
    hits, shadow = cast_shadows(lamps, *shapes)
    scene, first_tool_face = join_shapes(*shapes), len(bump.faces) + 2
    assert not shadow[hits.face >= first_tool_face].any()
    pixels = np.flatnonzero((hits.face >= 0) & (hits.face < first_tool_face))
    penumbra = pixels[(shadow[pixels] > 0.05) & (shadow[pixels] < 0.95)]
    pixels = np.concatenate([penumbra[:: len(penumbra) // 8], pixels[:: len(pixels) // 5]])  # trimesh is slow
    points = (LENS.centre + hits.along[:, None] * RAYS @ LENS.rotation)[pixels]
    solid = [
        trimesh.Trimesh(scene.vertices, part, process=False)
        for part in np.split(scene.faces, [first_tool_face])
    ]
    vertex_normals = np.concatenate([normals(shape) for shape in shapes])
    normal = np.einsum("nk,nkc->nc", hits.bary[pixels], vertex_normals[scene.faces[hits.face[pixels]]])
    light = np.zeros((2, len(pixels)))
    for lamp in lamps:
        start, axes = window(lamp)
        for ray in (start @ axes[:2] + lamp.position)[:, None] - points:
            distance = np.linalg.norm(ray, axis=1)[:, None]
            bright = np.maximum((normal * ray).sum(axis=1), 0) * -(ray @ axes[2]) / distance[:, 0] ** 4
            is_ground_blocked, is_tool_blocked = (
                mesh.ray.intersects_any(points + 1e-3 * ray / distance, ray) for mesh in solid
            )
            light += (
                bright * lamp.intensity.sum() * ~is_ground_blocked * [np.ones(len(pixels)), is_tool_blocked]
            )
    error = np.abs(shadow[pixels] - light[1] / np.maximum(light[0], 1e-300))
    assert np.median(error) < 1e-6
    assert error.max() < 0.04  # a ray through an edge may go either way


@pytest.mark.parametrize("radius", [3.0, 12.0])
def test_a_half_plane_takes_a_segment_of_a_disc_lamp(radius: float) -> None:
    """From p on the ground, an edge at x = 1 mm, 20 mm up, is at 5 - 4 p on a lamp 100 mm up."""
    lamps = [Lamp(np.array([0.0, 0.0, 100.0]), np.zeros(3), radius, np.ones(3))]
    hits, shadow = cast_shadows(
        lamps, plate(-20.0, 20.0, 0.0), plate(60.0, 61.0, 0.0), plate(-30.0, 1.0, 20.0)
    )
    ground_pixels = (hits.face >= 0) & (hits.face < 2)
    points = LENS.centre + hits.along[ground_pixels, None] * RAYS[ground_pixels] @ LENS.rotation
    edge = np.clip((5 - 4 * points[:, 0]) / radius, -1, 1)
    share = 1 - (np.arccos(edge) - edge * np.sqrt(1 - edge**2)) / np.pi
    np.testing.assert_allclose(shadow[ground_pixels], share, atol=0.07)  # by 32 rays
    assert np.abs(shadow[ground_pixels] - share).mean() < 0.01
    assert ((share > 0.1) & (share < 0.9)).sum() > 20


def test_in_another_bodys_shadow_it_is_a_share_of_the_light_that_is_left() -> None:
    """A body takes the left half of the lamp from the origin, an instrument the left three quarters."""
    lamps = [Lamp(np.array([0.0, 0.0, 100.0]), np.zeros(3), 5.0, np.ones(3))]
    start, axes = window(lamps[0])
    x = (start @ axes[:2])[:, 0]
    half, most = np.quantile(x, [0.5, 0.75], method="nearest") + 1e-6
    hits = truth.Hits(np.array([0]), np.array([[0.5, 0.0, 0.5]]), np.array([100.0]))
    ground, rim, tool = (
        plate(-20.0, 20.0, 0.0),
        plate(-30.0, 0.2 * half, 20.0),
        plate(-30.0, 0.1 * most, 10.0),
    )
    share = ((x > half) & (x < most)).sum() / (x > half).sum()
    assert shadow_map(hits, (ground, rim, tool), lamps, (1, 1))[0, 0] == pytest.approx(share, abs=0.01)
    assert shadow_map(hits, (ground, plate(-30.0, 30.0, 30.0), tool), lamps, (1, 1))[0, 0] == 0
