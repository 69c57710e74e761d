"""The Bayesian inverse against loads of another mesh, theory of the half-space, and draws from itself."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from half_space import press_surface
from numpy.typing import NDArray

from bench.methods import force_mixture, physics, posterior, tissue_weights
from bench.methods.compliance import ElasticBlock, TissueKind
from bench.methods.method_interface import FrameMotion, MethodContext
from bench.methods.posterior import LoadBasis, Observation
from bench.methods.tissue_weights import candidate_tissues, infer, weigh_tissues

Floats = NDArray[np.float64]
BARE = TissueKind("bonded", 0.0, 0.45)
STILL = np.zeros((3, 6, 0))  # no own motion


def observe(displacement: Floats, noise_mm: float = 0.0, seed: int = 0) -> Observation:
    """(P, C) mm with white noise, whose deviation is stated."""
    noise = noise_mm * np.random.default_rng(seed).normal(size=displacement.shape)
    return Observation((displacement + noise).T, np.full(displacement.T.shape, max(noise_mm, 0.01)))


@cache
def other_mesh(tissue: TissueKind) -> ElasticBlock:
    return ElasticBlock.build(2500, tissue)


def press(basis: LoadBasis, tissue: TissueKind, force: list[float]) -> Floats:
    """Displacement (P, 3) mm, camera axes, of a 3 mm contact at (2, 3) mm on another mesh; mN/kPa."""
    block = other_mesh(tissue)
    steps = np.stack(np.meshgrid(np.linspace(-1, 1, 13), np.linspace(-1, 1, 13)), axis=-1).reshape(-1, 2)
    disc = steps[np.hypot(*steps.T) < 1]
    share = (1 - np.square(disc).sum(axis=1)) ** 2
    load = np.outer(share / share.sum(), np.array(force) * [1, -1, -1])
    u = block.system.solve(block.embed(np.array([2.0, 3.0]) + 3 * disc).gather(load))
    return np.asarray(block.embed(basis.lattice.points).move(u) * [1, -1, -1], np.float64)


@pytest.fixture(scope="module")
def basis() -> LoadBasis:
    return posterior.load_basis(3, BARE)


@pytest.mark.slow
@pytest.mark.parametrize("force", [[3.0, 0.0, 0.0], [0.0, -1.0, 4.0]])
def test_a_contacts_force_is_estimated_and_in_its_interval(basis: LoadBasis, force: list[float]) -> None:
    displacement = press(basis, BARE, force)
    for noise in (0.0, 0.03):
        estimate = posterior.infer(basis, observe(displacement, noise), STILL)
        assert estimate.force.mean == pytest.approx(force, abs=0.1 * np.linalg.norm(force))
        low, high = physics.size_interval(estimate.force, 0.08)
        assert low < np.linalg.norm(force) < high
        assert estimate.load.sum(axis=0) == pytest.approx(estimate.force.mean, abs=1e-6)
    monocular = posterior.infer(posterior.load_basis(2, BARE), observe(displacement[:, :2], 0.01), STILL[:2])
    assert monocular.force.mean[:2] == pytest.approx(force[:2], abs=0.15 * np.linalg.norm(force))


@pytest.mark.slow
def test_monocular_intervals_cover_presses_along_the_optical_axis(basis: LoadBasis) -> None:
    monocular, inside, count = posterior.load_basis(2, BARE), 0, 0
    for size in (1.0, 2.0, 3.0, 5.0):
        displacement = press(basis, BARE, [0.0, 0.0, size])[:, :2]
        for noise in (0.04, 0.06):
            for seed in range(5):
                estimate = posterior.infer(monocular, observe(displacement, noise, seed), STILL[:2])
                low, high = physics.size_interval(estimate.force, 0.08, cameras=1)
                inside, count = inside + (low <= size <= high), count + 1
    assert inside >= 0.85 * count


@pytest.mark.slow
def test_no_motion_is_no_force(basis: LoadBasis) -> None:
    for noise in (0.0, 0.03):
        estimate = posterior.infer(basis, observe(np.zeros((len(basis.lattice.points), 3)), noise), STILL)
        low, high = physics.size_interval(estimate.force, 0.08)
        assert np.linalg.norm(estimate.force.mean) < 0.2
        assert low == 0.0
        assert 0 < high < 0.6


@pytest.mark.slow
def test_the_tissues_own_motion_is_estimated_from_contact_free_frames(basis: LoadBasis) -> None:
    rng = np.random.default_rng(1)
    terms = posterior.polynomials(basis.lattice.points)
    shape = rng.normal(size=(6, 3)) * [0.0, 0.05, 0.25]  # lifts and bends as one; twice that is stated
    motions = [terms @ (np.sin(k) * shape) for k in range(1, 10)]
    modes = posterior.own_motion(basis, [observe(motion, 0.005) for motion in motions[:8]])
    sizes = np.sqrt(np.square(modes).sum(axis=2).mean(axis=1))
    assert sizes == pytest.approx(np.sqrt(2 * np.square(shape).mean(axis=0)), rel=0.5, abs=0.03)
    assert np.square(modes[..., -1]).sum() > 0.8 * np.square(modes).sum()
    force = np.array([0.5, 0.0, 2.0])
    observation = observe(press(basis, BARE, force.tolist()) + motions[8], 0.01)
    known, unknown = (posterior.infer(basis, observation, size).force.mean for size in (modes, STILL))
    assert np.linalg.norm(known - force) < 0.25 * np.linalg.norm(force)
    assert np.linalg.norm(known - force) < 0.5 * np.linalg.norm(unknown - force)


@pytest.mark.slow
def test_intervals_have_90_percent_coverage_of_draws_from_the_model(basis: LoadBasis) -> None:
    rng, inside, count, model = np.random.default_rng(2), 0, 150, posterior.MODEL
    sizes = np.repeat([0.02, 0.02, 0.05], 6)
    modes = np.diag(sizes).reshape(3, 6, 18)
    for _ in range(count):
        spread, size = rng.choice(model.smooth), np.array(rng.choice(model.contacts))
        smooth = spread * basis.size * rng.normal(size=len(basis.size))
        contact = size * rng.normal(size=3)
        inward = basis.contacts[:, rng.integers(basis.contacts.shape[1])] @ contact
        coefficients = np.append(smooth + inward, sizes * rng.normal(size=18))
        remainder = np.sqrt(basis.omitted) * spread * rng.normal(size=3)
        force = basis.force @ smooth + remainder + contact
        displacement = (basis.motion @ coefficients).reshape(3, -1)
        # With the model's enlarged variances.
        local = basis.around @ np.square(displacement).mean(axis=0)
        noise = np.sqrt(model.correlated * (0.02**2 + model.least_mm**2 + model.misfit**2 * local))
        observation = Observation(
            displacement + noise * rng.normal(size=displacement.shape), np.full(displacement.shape, 0.02)
        )
        low, high = physics.size_interval(posterior.infer(basis, observation, modes).force, 0.0)
        inside += low <= np.linalg.norm(force) <= high
    assert abs(inside / count - 0.9) < 3 * np.sqrt(0.09 / count)


@pytest.mark.slow
def test_force_on_an_elastic_half_space_is_estimated(basis: LoadBasis) -> None:
    nu, force = 0.45, np.array([1.0, 0.0, 3.0])
    displacement = press_surface(basis.lattice.points, force, nu)
    free = posterior.load_basis(3, TissueKind("free", 0.0, nu))
    # The block's walls are fixed 50 mm away, where the half-space still sinks: allowed as own motion.
    estimate = posterior.infer(free, observe(displacement, 0.01), 0.05 * np.eye(18).reshape(3, 6, 18))
    assert estimate.force.mean == pytest.approx(force, abs=0.15 * 3.2)


@pytest.mark.slow
def test_a_membrane_is_estimated_from_the_video_and_restricted_by_meta(
    basis: LoadBasis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tissue_weights, "TISSUES", replace(tissue_weights.TISSUES, stretches=(1.0,)))
    edge_seen = np.pad(np.ones((80, 80), bool), 20)
    scene = MethodContext(edge_seen, 12 * np.sqrt(np.pi) / 80, 2.0, poisson=(0.45, 0.45))
    stiff = []
    for tissue in (BARE, TissueKind("bonded", 40.0, 0.45)):
        frames = [observe(press(basis, tissue, [1.0, 0.0, level]), 0.01) for level in (2.0, 4.0)]
        weights = weigh_tissues(scene, frames, STILL)
        stiff.append(weights.tissues[0].membrane)
    # On another mesh bare tissue may be taken for a thin membrane, never for a thick one.
    assert stiff[0] <= 5
    assert stiff[1] > 20
    stated_scene = MethodContext(scene.tissue, scene.scale_mm_per_px, 2.0, "stripped", (0.48, 0.49))
    assert {(candidate.membrane, candidate.poisson) for candidate in candidate_tissues(stated_scene)} == {
        (0.0, 0.49)
    }


@pytest.mark.slow
def test_a_stated_stiffness_of_the_membrane_gives_the_force(basis: LoadBasis) -> None:
    side, tissue, young = 80, TissueKind("bonded", 40.0, 0.45), 2.0
    context = np.ones((side, side), bool), 12 * np.sqrt(np.pi) / side, young, "intact", (0.45, 0.45)
    frames = [observe(press(basis, tissue, [1.0, 0.0, level]), 0.01) for level in (2.0, 4.0)]
    true, sizes = np.hypot(1.0, 4.0), []
    for stiff in ((80.0, 80.0), (10.0, 10.0)):
        scene = MethodContext(*context, membrane_mn_per_mm=stiff)
        weights = weigh_tissues(scene, frames, STILL)
        assert {tissue.membrane for tissue in weights.tissues} == {stiff[0] / young}
        sizes.append(float(np.linalg.norm(infer(weights, frames[1]).force.mean)))
    assert sizes[0] == pytest.approx(true, rel=0.15)
    assert sizes[1] < 0.9 * sizes[0], "a membrane that is stated too soft hides force"
    between = MethodContext(*context, membrane_mn_per_mm=(60.0, 100.0))
    assert {candidate.membrane for candidate in candidate_tissues(between)} == {
        30.0,
        39.0,
        50.0,
    }


def test_evidence_for_a_soft_membrane_is_not_taken_for_certain() -> None:
    tissues = [TissueKind("bonded", membrane, 0.45, 1.02) for membrane in (5.0, 15.0, 40.0, 100.0)]
    shares = tissue_weights._share(tissues, [0.0, -20.0, -80.0, -400.0], [-1.0, -1.0, -1.0, -1.0])
    weight = np.exp(list(shares.values()))
    assert len(shares) == 3
    assert weight.max() == pytest.approx(np.exp(-1.0))
    assert weight.max() / weight.min() == pytest.approx(np.exp(2.0), rel=0.01)


def test_the_quietest_frames_bound_the_tissues_own_motion() -> None:
    """A pulse of known amplitude, with a contact in a half of the frames."""
    time_s, none = np.arange(100) / 10, np.full((2, 9), 0.001)
    pulse_mm = 0.2 * (1 - np.cos(2 * np.pi * 0.25 * time_s)) + (time_s > 5) * 1.0
    still = [posterior.Observation(np.full((2, 9), 0.001 + (k > 50)), none) for k in range(100)]
    frames = [posterior.Observation(np.full((2, 9), size), none) for size in pulse_mm]
    for observations, low, high in ((frames, 0.1, 0.5), (still, 0.0, 0.03)):
        quiet, factor = physics.quietest_frames(time_s, observations)
        assert low <= factor * max(observations[k].size_mm for k in quiet) <= high
    # A tenth of a second may be where breath turns.
    assert physics.quietest_frames(time_s[:2], still[:2])[1] > 100


def test_a_short_span_does_not_exclude_a_breath() -> None:
    own_mm, shape = list[float](), np.ones((80, 80, 2), np.float32)
    for living, free_frames in ((True, 0), (True, 2), (False, 2)):
        scene = MethodContext(np.ones((80, 80), bool), 0.4, 2.0, "stripped", (0.45, 0.45), living=living)
        method = physics.Physics()
        for k in range(10):  # half a second shows little of a breath that has just turned
            flow = shape * np.float32(1 - np.cos(2 * np.pi * 0.23 * (k / 2 + 0.3)))
            method(FrameMotion(flow, shape[..., 0], time_s=k / 2), scene, False)
        method.revise(np.arange(10) < free_frames)
        own_mm.append(float(np.abs(method._weights.own_mm).max(initial=0.0)))
    assert 0 < own_mm[0] == own_mm[1] != own_mm[2]  # a specimen, which does not breathe, is measured


def test_an_interval_holds_every_assumption_however_unlikely() -> None:
    first, second = (
        force_mixture.ForceMixture(np.ones(1), np.array([[size, 0, 0]]), 1e-4 * np.eye(3)[None])
        for size in (1.0, 4.0)
    )
    mixture = force_mixture.mix([first, second], np.array([1 - 1e-9, 1e-9]), [0, 1])
    low, high = force_mixture.size_interval(mixture, 0.0)
    assert np.linalg.norm(mixture.mean) == pytest.approx(1)
    assert low < 1
    assert high > 3.9
