"""Forces of tenths of a newton from exact motion: felupe's, and our own in wide openings."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from dome import patch
from driven_gesture import gesture
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator

from bench.methods import large_motion, physics, posterior
from bench.methods.compliance import DOME_MM, TissueKind
from bench.methods.method_interface import FrameMotion, MethodContext
from bench.methods.tissue_weights import TissueWeights, infer
from evidence.fem.solvers import FELUPE, OPENING_MM, compare_estimate, motion_of
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.motion import TimeScheme
from synth.fem.solver import deform
from synth.flow.stereo.stereo_track import Motion3D

SCENES = FELUPE["openings"]


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: f"{scene['alpha']:g}")
def test_the_force_behind_felupes_motion_is_found(scene: dict) -> None:  # type: ignore[type-arg]
    comparison = compare_estimate(scene)
    assert comparison["slope"] > max(large_motion.STEEP.values())
    assert comparison["force_error"] <= 0.12


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES[1:2], ids=lambda scene: f"{scene['alpha']:g}")
def test_motion_that_is_hardly_known_imposes_less(scene: dict) -> None:  # type: ignore[type-arg]
    """Beside felupe's contact a strip is seen 1.5 mm off, as flow that is lost is."""
    grid = physics.GRID
    axis = (np.arange(grid.size) - (grid.size - 1) / 2) * grid.pitch_mm
    x, y = np.meshgrid(axis, axis)
    displacement, force = motion_of(scene, x, y)
    moved, strip, errors = np.moveaxis(displacement, -1, 0).copy(), x < -7, []
    moved[0, strip] = 1.5
    for stated_mm in (0.01, 2.0):
        deviation = np.full(moved.shape, 0.01)
        deviation[:, strip] = stated_mm
        motion = large_motion.measure_motion(moved, deviation, np.hypot(x, y) < OPENING_MM, grid)
        tissue = TissueKind("bonded", 0.0, scene["poisson"])
        answer = large_motion.reaction(motion, tissue, OPENING_MM, scene["alpha"])
        errors.append(np.linalg.norm(answer - force) / np.linalg.norm(force))
    assert errors[1] < 0.4 * errors[0]


@pytest.mark.parametrize("opening_mm", [18.0, pytest.param(25.0, marks=pytest.mark.slow)])
def test_the_force_is_found_where_the_picture_cuts_a_wide_opening(opening_mm: float) -> None:
    direction = np.array([1.0, 0.2, -0.15])
    pull = gesture(
        "retract", tuple(direction / np.linalg.norm(direction)), 4.5, size=(14.0, 9.0), place=(-3.0, 0.0)
    )
    tissue, surface = Tissue(1.0, 0.45, "ogden", alpha=-8.0), patch(61, 46.0)
    tets = tetrahedra.block(700, list(pull.focus), opening_mm=opening_mm, dome_mm=DOME_MM)
    motion = deform(TimeScheme(), tissue, [pull], tets, surface, 3, 5.0)
    force, grid = motion.force[1] * [1, -1, -1], physics.GRID
    axis = (np.arange(grid.size) - (grid.size - 1) / 2) * grid.pitch_mm
    x, y = np.meshgrid(axis, axis)
    interpolate = CloughTocher2DInterpolator(surface.vertices[:, :2], motion.displacement[1])
    displacement = np.moveaxis(interpolate(np.stack([x, -y], axis=-1)) * [1, -1, -1], -1, 0)
    in_view = (np.maximum(np.abs(x), np.abs(y)) < 13) & (np.hypot(x, y) < opening_mm)
    deviation, bare = np.full(displacement.shape, 0.01), TissueKind("bonded", 0.0, 0.45)
    observation = large_motion.measure_motion(displacement, deviation, in_view, grid)
    answer = large_motion.reaction(observation, bare, None, -8.0)
    assert np.linalg.norm(answer - force) <= 0.1 * np.linalg.norm(force)
    displacement[2, (x < -10) & (y > 10)] += 1.0  # as under a shaft
    mistaken = large_motion.measure_motion(displacement, deviation, in_view, grid)
    assert mistaken.slope == pytest.approx(observation.slope, rel=0.01)
    other_answer = large_motion.reaction(mistaken, bare, None, -8.0)
    assert np.linalg.norm(other_answer - force) <= 0.15 * np.linalg.norm(force)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "cameras", "membrane"),
    [(0, 1, "stripped"), (2, 1, "intact"), (0, 2, "stripped"), (2, 2, "stripped")],
)
def test_large_forces_are_estimated_or_said_to_be_out_of_range(
    number: int, cameras: int, membrane: Literal["stripped", "intact"]
) -> None:
    scene, side, young_kpa, scale = SCENES[number], 120, 4.0, 0.22
    axis = (np.arange(side) - (side - 1) / 2) * scale
    x, y = np.meshgrid(axis, axis)
    displacement, force = motion_of(scene, x, y)
    size = young_kpa * np.linalg.norm(force)
    assert size > 100
    poisson, alpha = (scene["poisson"],) * 2, (scene["alpha"],) * 2
    tissue = np.hypot(x, y) < OPENING_MM
    context = MethodContext(tissue, scale, young_kpa, membrane, poisson, living=False, alpha=alpha)
    if membrane == "intact":
        context = replace(context, membrane_mn_per_mm=(40.0, 40.0))
    method, confidence = physics.Physics(), np.ones(x.shape, np.float32)
    for part in (0.0, 0.0, 1.0):
        flow = (part * displacement[..., :2] / scale).astype(np.float32)
        stereo_motion = Motion3D(
            (part * displacement).astype(np.float32), np.full(displacement.shape, 0.01, np.float32)
        )
        method(FrameMotion(flow, confidence, motion=stereo_motion if cameras == 2 else None), context, False)
    answer = method.revise(np.array([True, True, False]))[-1]
    if cameras == 2:
        assert answer.size_mn == pytest.approx(size, rel=0.12)
    if membrane == "stripped" or cameras == 2:
        assert answer.low_mn <= size <= answer.high_mn
    else:
        assert np.isnan([answer.low_mn, answer.high_mn]).all()
    assert bool(method.warnings) == (cameras == 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "share", "error"), [(0, 0.4, 0.05), (1, 0.4, 0.05), (0, 0.1, 0.25), (3, 0.1, 0.35)]
)
def test_the_tissues_own_motion_is_not_taken_for_force(number: int, share: float, error: float) -> None:
    """Tissue rises by 0.3 mm, alone for ten seconds, then while a share of felupe's contact pulls it."""
    scene, side, scale = SCENES[number], 120, 0.22
    axis = (np.arange(side) - (side - 1) / 2) * scale
    x, y = np.meshgrid(axis, axis)
    displacement, _ = motion_of(scene, x, y)
    radius = np.hypot(x, y) / OPENING_MM
    own_motion = np.stack([0.1 * x / OPENING_MM, 0.1 * y / OPENING_MM, 0.3 * (1 - radius**2)], axis=-1)
    poisson, alpha = (scene["poisson"],) * 2, (scene["alpha"],) * 2
    loads, phases = np.append(np.zeros(11), share), 0.5 - 0.5 * np.cos(0.2 * np.pi * np.arange(12))
    phases[-1], sizes = 1.0, []
    for rise in (0.0, 1.0):
        context = MethodContext(radius < 1, scale, 4.0, "stripped", poisson, living=True, alpha=alpha)
        method, confidence = physics.Physics(), np.ones(x.shape, np.float32)
        for second, (load, phase) in enumerate(zip(loads, phases, strict=True)):
            moved = (load * displacement + rise * phase * own_motion).astype(np.float32)
            motion = Motion3D(moved, np.full(moved.shape, 0.01, np.float32))
            frame = FrameMotion(moved[..., :2] / scale, confidence, motion=motion, time_s=float(second))
            method(frame, context, False)
        sizes.append(method.revise(loads == 0)[-1].size_mn)
    assert sizes[1] == pytest.approx(sizes[0], rel=error)


def test_own_motion_is_taken_off_about_the_middle_of_the_loads() -> None:
    rng, middle_mm = np.random.default_rng(3), np.array([5.0, -3.0])
    points, modes = rng.uniform(-12, 12, (40, 2)), rng.normal(scale=0.1, size=(3, 6, 2))
    own_mm = posterior.polynomials(points - middle_mm) @ (modes @ [0.5, -0.3]).T
    motion = large_motion.SeenMotion(points, own_mm + 1.0, np.ones(40), 1.0, 0.2, np.ones(40, bool))
    observation = posterior.Observation(np.zeros((3, 9)), np.ones((3, 9)))
    frame = physics.LargeFrame(observation, motion, middle_mm)
    rest = physics.take_off_own_motion(frame, modes, np.array([0.5, -0.3]))
    np.testing.assert_allclose(rest.moved, 1.0)
    none = physics.take_off_own_motion(frame, modes[..., :0], np.zeros(0))
    np.testing.assert_array_equal(none.moved, motion.moved)
    more, most = (physics.take_off_own_motion(frame, modes, np.array([a, -a])) for a in (0.8, 9.0))
    np.testing.assert_array_equal(more.moved, most.moved)


def observe_scene(scene: dict[str, Any]) -> tuple[MethodContext, NDArray[Any], NDArray[Any]]:
    """Of 0.4 of felupe's load on bare tissue: what is known, and motion and deviation (3, N, N) mm."""
    grid = physics.GRID
    axis = (np.arange(grid.size) - (grid.size - 1) / 2) * grid.pitch_mm
    x, y = np.meshgrid(axis, axis)
    moved = 0.4 * np.moveaxis(motion_of(scene, x, y)[0], -1, 0)
    poisson, alpha = (scene["poisson"],) * 2, (scene["alpha"],) * 2
    context = MethodContext(np.hypot(x, y) < OPENING_MM, grid.pitch_mm, 4.0, "stripped", poisson, alpha=alpha)
    return context, moved, np.full(moved.shape, 0.01)


@pytest.mark.slow
def test_motion_that_opposes_the_linear_force_is_not_solved() -> None:
    context, moved, deviation = observe_scene(SCENES[0])
    tissue, no_motion = TissueKind("bonded", 0.0, context.poisson[0]), np.zeros((3, 6, 0))
    weights = TissueWeights((tissue,), np.ones(1), no_motion, False)
    observation = physics.observe(moved, deviation, context.tissue)
    for sign in (1, -1):
        motion = large_motion.measure_motion(sign * moved, deviation, context.tissue, physics.GRID)
        gains = physics.find_gains(context, weights, [physics.LargeFrame(observation, motion, np.zeros(2))])
        assert gains.unsolved == (sign < 0)
        assert ((gains.low[-1], gains.high[-1]) == physics.PHYSICS.unsolved) == (sign < 0)


@pytest.mark.slow
def test_where_own_motion_is_only_bounded_the_gain_holds_still_tissue() -> None:
    context, moved, deviation = observe_scene(SCENES[0])
    motion = large_motion.measure_motion(moved, deviation, context.tissue, physics.GRID)
    frame = physics.LargeFrame(physics.observe(moved, deviation, context.tissue), motion, np.zeros(2))
    tissue, modes = TissueKind("bonded", 0.0, context.poisson[0]), np.zeros((3, 6, 1))
    modes[2, 0], modes[2, 3], modes[2, 5] = 0.3, -0.3, -0.3  # the middle rises and sinks
    ends = {}
    for name, own_mm, assumed in (
        ("still", modes[..., :0], False),
        ("seen", modes, False),
        ("bounded", modes, True),
    ):
        weights = TissueWeights((tissue,), np.ones(1), own_mm, assumed)
        gains, size = (
            physics.find_gains(context, weights, [frame]),
            infer(weights, frame.observation).force.mean,
        )
        ends[name] = np.linalg.norm(size) * np.array([gains.low[-1], gains.high[-1]])
    assert np.ptp(ends["still"]) == np.ptp(ends["seen"]) == 0
    np.testing.assert_allclose(ends["bounded"], np.sort([ends["seen"][0], ends["still"][0]]), rtol=1e-4)
    assert np.ptp(ends["bounded"]) > 0.05 * ends["still"][0]
