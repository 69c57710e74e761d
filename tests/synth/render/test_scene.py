"""The renderer on every variant that runs here."""

import os
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from synth.job import reader
from synth.job.schema import AnatomySection, Job, RenderSection
from synth.render import idle
from synth.render.anatomy import rim
from synth.render.anatomy import surface as anatomy
from synth.render.camera import camera
from synth.render.craniotomy import build_craniotomy
from synth.render.mitsuba.adapter import pick
from synth.render.scene import Renderer, SceneState
from synth.sequence import scenario
from synth.sequence.draw import place_right, read_lens
from synth.sequence.rest_scene import at_rest
from synth.system import gpu, llvm

pytestmark = pytest.mark.slow
VARIANTS = ["scalar_rgb"]
VARIANTS += ["llvm_ad_rgb"] * bool(llvm.find()) + ["cuda_ad_rgb"] * (gpu.obstacle(gpu.probe()) is None)
TIPS = np.array([[-1.0, 1.0, 0.2], [1.2, 1.4, 0.2]])
SHAFTS = np.array([[0.6, 0.3, 0.74], [0.6, 0.3, 0.74]])


def build_renderer(
    variant: str, spp: int = 4, extra: tuple[str, ...] = (), tool: bool = True, **render: object
) -> tuple[Renderer, np.ndarray]:
    settings = {"size": (96, 72), "spp": spp, "variant": variant, "scenery": (), **render}
    job = Job(anatomy=AnatomySection(vertices=2500), render=RenderSection.model_validate(settings))
    surface = anatomy.grow(scenario.draw_relief(job.anatomy, np.random.default_rng(4)), vertices=2500)
    view = scenario.draw_view(job.render, np.random.default_rng(4))
    appearance = scenario.draw_appearance(job, "healthy", np.random.default_rng(4))
    appearance = replace(appearance, scenery=job.render.scenery)
    lens = camera.place(view, read_lens(job.render))
    content = build_craniotomy(surface, appearance, lens, 12.0, [("forceps" if tool else "none", 4.0)])
    right = place_right(job.render, lens)
    renderer = Renderer(content, lens, appearance.sensor, extra, right, spp=spp, variant=variant)
    return renderer, surface.vertices


def test_same_seed_same_bytes() -> None:
    renderer, vertices = build_renderer(VARIANTS[-1])
    shots = [renderer.render(SceneState(vertices, TIPS, SHAFTS), seed) for seed in (7, 8, 7)]
    assert (shots[0].rgb == shots[2].rgb).all()
    assert (shots[0].radiance == shots[2].radiance).all()
    assert (shots[0].rgb != shots[1].rgb).any()
    assert np.isfinite(shots[0].radiance).all()
    second_renderer, _ = build_renderer(VARIANTS[-1])
    assert (second_renderer.render(SceneState(vertices, TIPS, SHAFTS), 7).rgb == shots[0].rgb).all()


def test_the_picture_moves_with_the_truth() -> None:
    """The picture follows a sideways shift of the cortex by the flow, and by no other shift."""
    renderer, vertices = build_renderer(VARIANTS[-1], spp=64, tool=False)
    rest_shot = renderer.render(SceneState(vertices, TIPS, SHAFTS), 1)
    pixel = renderer.rest.scale_mm_per_px
    moved_shot = renderer.render(
        SceneState(vertices + renderer.camera.rotation[0] * 3 * pixel, TIPS, SHAFTS), 2
    )
    inside = np.zeros_like(renderer.rest.tissue)
    inside[20:-20, 30:-30] = True
    inside &= renderer.rest.tissue & ~rest_shot.glare & ~np.roll(moved_shot.glare, -3, axis=1)
    np.testing.assert_allclose(np.median(moved_shot.flow[inside], axis=0), [3, 0], atol=0.1)
    green = [shot.rgb[..., 1].astype(float) for shot in (rest_shot, moved_shot)]
    errors = {d: np.abs(np.roll(green[1], -d, axis=1) - green[0])[inside].mean() for d in range(7)}
    assert min(errors, key=lambda d: errors[d]) == 3


@pytest.mark.parametrize("variant", VARIANTS[1:])
def test_variants_agree_pixel_by_pixel(variant: str) -> None:
    """Undistorted, means of independent frames differ within their standard errors (Mitsuba's z-test)."""
    frames, stacks = 8, []
    for name, seed in (("scalar_rgb", 50), (variant, 90)):
        renderer, vertices = build_renderer(name, spp=16, size=(64, 48), distortion=(0.0,) * 5)
        shots = [renderer.render(SceneState(vertices, TIPS, SHAFTS), seed + k) for k in range(frames)]
        stacks.append(np.stack([shot.radiance.mean(axis=2) for shot in shots]))
    scalar_stack, variant_stack = stacks
    error = np.sqrt((scalar_stack.var(axis=0, ddof=1) + variant_stack.var(axis=0, ddof=1)) / frames)
    z = (scalar_stack.mean(axis=0) - variant_stack.mean(axis=0)) / np.maximum(error, 1e-4)
    assert abs(z.mean()) < 0.15
    assert z.std() < 1.3
    assert (np.abs(z) > 4.5).mean() < 0.01


def test_few_paths_have_the_mean_of_many() -> None:
    renderer, vertices = build_renderer(VARIANTS[-1], spp=4)
    dense_renderer, _ = build_renderer(VARIANTS[-1], spp=256)
    state = SceneState(vertices, TIPS, SHAFTS)
    sparse_mean = np.mean([renderer.render(state, seed).radiance for seed in range(12)], axis=0)
    difference = sparse_mean - dense_renderer.render(state, 1).radiance
    assert abs(difference.mean()) < 0.002
    assert np.median(np.abs(difference)) < 0.004


def test_tissue_is_visible_through_the_opening_only() -> None:
    """The wound's floor lies lower than the dura in front of it, and over the brain."""
    for seed in range(3):
        job = Job(seed=seed, anatomy=AnatomySection(vertices=6000), render={"size": (192, 144)})
        scene = at_rest(job)
        rest, appearance = scene.renderer.rest, scene.scenario.appearance
        edge = rim.build(
            scene.surface, job.anatomy.craniotomy.radius_mm, appearance, scene.view.mm_per_px
        ).edge
        points = scene.view.rotation.T @ (rest.points[rest.tissue.ravel()] - scene.view.translation).T
        angles = 2 * np.pi * np.arange(len(edge)) / len(edge)
        opening = np.interp(np.arctan2(points[1], points[0]), angles, edge, period=2 * np.pi)
        assert (np.hypot(points[0], points[1]) < opening + 1.0).all()


def test_drapes_have_straight_hems_behind_the_wound() -> None:
    job = Job(
        seed=5, anatomy=AnatomySection(vertices=6000), render={"size": (192, 144), "scenery": ["drape"]}
    )
    scene = at_rest(job)
    rim_shape = rim.build(
        scene.surface, job.anatomy.craniotomy.radius_mm, scene.scenario.appearance, scene.view.mm_per_px
    )
    assert (rim_shape.cloth >= rim_shape.wall + rim.Drape.over_wall - 1e-9).all()
    angle = 2 * np.pi * np.arange(len(rim_shape.edge)) / len(rim_shape.edge)
    hem = (rim_shape.edge + rim_shape.cloth) * np.exp(1j * angle)
    segments = np.diff(np.append(hem, hem[0]))
    bends = np.abs(np.angle(np.roll(segments, -1) / segments))
    assert np.mean(bends < 1e-6) > 0.5, "most of it lies on a few straight lines"
    bare_job = job.model_copy(update={"render": job.render.model_copy(update={"scenery": ()})})
    bare_scene = at_rest(bare_job)
    appearance = bare_scene.scenario.appearance
    assert not len(rim.build(bare_scene.surface, 12.0, appearance, bare_scene.view.mm_per_px).cloth)


def test_traction_is_in_camera_axes() -> None:
    renderer, vertices = build_renderer(VARIANTS[-1])
    nodal = np.zeros_like(vertices)
    nodal[:, 2] = 2.0  # pulled out of the brain, towards the lens
    label = renderer.traction(nodal)[renderer.rest.tissue]
    np.testing.assert_allclose(np.linalg.norm(label, axis=1), 2.0, rtol=1e-5)
    assert (label[:, 2] < -1.8).all()
    assert (renderer.traction(nodal)[~renderer.rest.tissue] == 0).all()


def test_without_llvm_the_scalar_variant_is_taken() -> None:
    code = "from synth.render.mitsuba.adapter import pick; print(pick('auto'))"
    environment = os.environ | {"PATH": "/usr/bin:/bin", "SULCUS_LLVM": ""}
    process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert process.stdout.strip() == "scalar_rgb"


def test_an_open_shutter_adds_up_light() -> None:
    renderer, vertices = build_renderer(VARIANTS[-1], spp=4, tool=False)
    moments = [SceneState(vertices, TIPS, SHAFTS, None, power) for power in (0.5, 1.5)]
    sharp_shot = renderer.render(SceneState(vertices, TIPS, SHAFTS), 1)
    blurred_shot = renderer.render(SceneState(vertices, TIPS, SHAFTS), 1, moments)
    assert blurred_shot.radiance.mean() == pytest.approx(sharp_shot.radiance.mean(), rel=0.01)
    assert (blurred_shot.flow == sharp_shot.flow).all()


def test_truth_on_request() -> None:
    """Flow to the next frame chains with flow from rest; normals face the lens."""
    renderer, vertices = build_renderer(VARIANTS[-1], spp=1, tool=False, extra=("flow_next", "normals"))
    push = np.exp(-(vertices[:, :2] ** 2).sum(axis=1) / 30)[:, None] * np.array([0.6, 0.2, 0.5])
    moments = [SceneState(vertices + k * push, TIPS, SHAFTS) for k in range(3)]
    shots = [renderer.render(moments[k], k, (), moments[min(k + 1, 2)]) for k in range(3)]
    first_shot, second_shot = shots[0], shots[1]
    # In the rest frame a pixel's point is the same for both.
    np.testing.assert_allclose(first_shot.flow_next, second_shot.flow, atol=1e-4)
    rows, columns = np.nonzero(renderer.rest.tissue & second_shot.visible & shots[2].visible)
    goal = np.stack([columns, rows], 1) + second_shot.flow[rows, columns]
    nearest_pixels = np.rint(goal).astype(int)
    is_close = np.abs(goal - nearest_pixels).max(axis=1) < 0.1
    next_flow = second_shot.flow_next[nearest_pixels[is_close, 1], nearest_pixels[is_close, 0]]
    chained_flow = second_shot.flow[rows, columns][is_close] + next_flow
    assert np.median(np.abs(chained_flow - shots[2].flow[rows, columns][is_close])) < 0.02
    assert first_shot.normals[renderer.rest.tissue][:, 2].max() < 0
    np.testing.assert_allclose(np.linalg.norm(first_shot.normals[renderer.rest.tissue], axis=1), 1, atol=1e-5)
    assert (shots[2].flow_next == 0).sum() > 0


def test_flow_of_all_that_is_seen_is_the_tissues_and_the_instruments() -> None:
    """An instrument that is shifted in parallel to the picture moves by focal length over depth."""
    renderer, vertices = build_renderer(
        VARIANTS[-1], spp=1, extra=("flow_next", "flow_next_all", "instrument")
    )
    shift = renderer.camera.rotation.T @ [0.7, 0.0, 0.0]
    state, next_state = (SceneState(vertices + 0.3 * k * shift, TIPS + k * shift, SHAFTS) for k in (0, 1))
    shot = renderer.render(state, 1, (), next_state)
    instrument_pixels = shot.instrument > 0
    assert instrument_pixels.sum() > 100
    tissue_pixels = (shot.depth > 0) & ~instrument_pixels & (shot.flow_next != 0).any(axis=-1)
    assert tissue_pixels.sum() > 100
    assert np.array_equal(shot.flow_next_all[tissue_pixels], shot.flow_next[tissue_pixels])
    expected = renderer.camera.K[0, 0] * 0.7 / shot.depth[instrument_pixels]
    np.testing.assert_allclose(shot.flow_next_all[instrument_pixels][:, 0], expected, rtol=0.02)


def test_rest_disparity_triangulates_to_the_rest_points() -> None:
    renderer, _ = build_renderer(VARIANTS[-1], spp=1, tool=False, stereo_mm=20.0)
    rows, columns = (indices[::50] for indices in np.nonzero(renderer.rest.tissue))
    pixels = np.stack([columns, rows], 1).astype(np.float64)
    left, right = renderer.camera, renderer.right
    left_pixels = cv2.undistortPoints(pixels[:, None], left.K, left.distortion, P=left.K)[:, 0]
    right_pixels = left_pixels - np.stack([renderer.disparity()[rows, columns], np.zeros(len(rows))], 1)
    poses = [np.eye(3, 4), np.concatenate([np.eye(3), [[-20.0], [0.0], [0.0]]], axis=1)]
    points = cv2.triangulatePoints(left.K @ poses[0], right.K @ poses[1], left_pixels.T, right_pixels.T)
    expected = renderer.rest.points.reshape(*renderer.rest.tissue.shape, 3)[rows, columns]
    np.testing.assert_allclose((points[:3] / points[3]).T, expected, atol=0.05)


def test_scenery_is_in_the_same_place_in_pictures_and_truth() -> None:
    """Its pixels differ from those of a scene without it, and tissue that moves under it is invisible."""
    bare_renderer, vertices = build_renderer("scalar_rgb", RenderSection().spp, tool=False)
    renderer, _ = build_renderer("scalar_rgb", RenderSection().spp, tool=False, scenery=("retractor",))
    state = SceneState(vertices, TIPS, SHAFTS)
    shot, bare_shot = renderer.render(state, 3), bare_renderer.render(state, 3)
    changed_pixels = np.abs(shot.radiance - bare_shot.radiance).max(axis=2) > 0.05
    hidden = bare_renderer.rest.tissue & ~renderer.rest.tissue
    assert changed_pixels[hidden].mean() > 0.8
    assert not shot.tool.any()
    assert not (shot.glare & hidden).any()
    pixel = renderer.rest.scale_mm_per_px
    # Aside and into the brain: scenery stays where it is, and tissue that rises would come through it.
    shifted_vertices = vertices + renderer.camera.rotation[0] * 6 * pixel - np.array([0, 0, 1.5])
    moved_shot = renderer.render(SceneState(shifted_vertices, TIPS, SHAFTS), 4)
    rows, columns = np.nonzero(renderer.rest.tissue)
    x = np.rint(columns + moved_shot.flow[rows, columns, 0]).astype(int)
    y = np.rint(rows + moved_shot.flow[rows, columns, 1]).astype(int)
    inside = (x > 0) & (x < 95) & (y > 0) & (y < 71)
    is_covered = np.zeros(len(rows), bool)
    # Well inside what hides: its outline moves with the camera's height over it.
    core = hidden & np.all([np.roll(hidden, step, axis) for step in (1, -1) for axis in (0, 1)], axis=0)
    is_covered[inside] = core[y[inside], x[inside]]
    assert is_covered.sum() > 10
    assert moved_shot.visible[rows, columns][is_covered].mean() < 0.05


SMALL = ["render.size=[64, 48]", "sequences=4", "anatomy.vertices=2500", "render.spp=4"]
_LARGE = 500  # operations: a kernel that traces light; the rest fill and copy arrays


def test_scenes_share_their_kernels_with_scenery_and_without() -> None:
    if pick("auto") == "scalar_rgb":
        pytest.skip("no LLVM here, so nothing is compiled")
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    bare_job = reader.load_job("demo", SMALL)
    scenery_job = reader.load_job("demo", [*SMALL, "render.scenery=[retractor, bone, drape, clips]"])
    large = []
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        for index, job in enumerate((bare_job, scenery_job)):
            scene = at_rest(job, index)
            for frame in range(2):
                state = SceneState(scene.surface.vertices + 0.1 * frame, TIPS + np.array([0, 0, 4]), SHAFTS)
                scene.renderer.render(state, seed=frame)
            kernels = [kernel for kernel in dr.kernel_history() if kernel.get("operation_count", 0) > _LARGE]
            large.append({kernel["hash"] for kernel in kernels})
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert large[0]
    assert all(hashes == large[0] for hashes in large), large


def test_idle_instruments_hide_tissue_and_touch_none() -> None:
    rest = at_rest(reader.load_job("demo", [*SMALL, "fem.instrument=none", "render.variant=scalar_rgb"]))
    bare_shot, hidden_pixels = rest.renderer.render(SceneState(rest.surface.vertices, TIPS, SHAFTS), 1), 0
    tissue = cKDTree(rest.surface.vertices[:, :2])
    for seed in range(5):
        idle_instruments = idle.draw_idle(1.0, np.random.default_rng(seed), 14.0, 15.0, np.zeros((0, 2, 3)))
        scene = replace(rest, draw=replace(rest.draw, scenario=replace(rest.scenario, idle=idle_instruments)))
        mesh = scene.renderer.content.instruments
        for seconds in (0.0, 1.3, 2.9) if idle_instruments else ():
            pose = idle.with_idle(idle_instruments, seconds, TIPS, SHAFTS)
            assert mesh is not None
            points = mesh.pose(*pose).vertices
            _, neighbours = tissue.query(points[:, :2], k=4, distance_upper_bound=1.0)
            surface_mm = np.append(rest.surface.vertices[:, 2], -np.inf)[neighbours].max(axis=1)
            assert (points[:, 2] - surface_mm).min() > 0
        if idle_instruments:
            shot = scene.renderer.render(SceneState(rest.surface.vertices, *pose), 1)
            covered = shot.tool & rest.tissue
            hidden_pixels += covered.sum()
            assert not (shot.visible & covered).any()
            np.testing.assert_array_equal(shot.flow, bare_shot.flow)
    assert hidden_pixels > 100
