"""Mechanics of others through the seam: a sealed store that verifies, on a user's brain; results refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import own_mechanics
import pytest
from egg_brain import soup, write_triangles
from own_mechanics import DENT_MM, DEPTH_MM, WIDTH_MM, Springs

import synth
from synth.checks import optics
from synth.checks.verify import verify_dataset
from synth.dataset.store import Dataset
from synth.fem.pulse import Pulse
from synth.geometry.brain_surface import load_brain, read_brain
from synth.geometry.skull import Craniotomy
from synth.render.camera import camera as cameras
from synth.sequence.rest_scene import RestScene, draw_craniotomy

TILTED = {"point": [20.0, 14.0, 12.0], "direction": [0.6, 0.4, 0.7], "radius_mm": 10.0}
SMALL = {"sequences": 1, "frames": 4, "fem": {"tets": 400}, "render": {"size": (96, 72), "spp": 1}}


@pytest.fixture(scope="module")
def egg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_triangles(tmp_path_factory.mktemp("brain") / "egg.obj", soup())


@pytest.fixture(scope="module")
def job(egg: Path) -> synth.Job:
    anatomy = {"mesh": egg, "vertices": 2500, "craniotomy": TILTED}
    return synth.Job.model_validate({"seed": 4, **SMALL, "anatomy": anatomy})


def draw_bare_scenario(job: synth.Job, pulse: Pulse | None = None) -> synth.Scenario:
    """The drawn scenario without instruments."""
    return replace(synth.draw_scenario(job, 0), gestures=(), pulse=pulse)


def test_a_placed_brain_is_mapped_back_to_the_coordinates_of_its_file(egg: Path) -> None:
    brain = load_brain(egg, Craniotomy(**TILTED))
    from_world = np.linalg.inv(brain.to_world)
    vertices = brain.shape.vertices @ from_world[:3, :3].T + from_world[:3, 3]
    assert np.abs(vertices - read_brain(egg)[0]).max() < 1e-9
    np.testing.assert_allclose(from_world[:3, :3] @ brain.to_world[:3, :3], np.eye(3), atol=1e-12)
    axis = brain.to_world[:3, :3] @ (np.array(TILTED["direction"]) / np.linalg.norm(TILTED["direction"]))
    np.testing.assert_allclose(axis, [0, 0, 1], atol=1e-12)


@pytest.mark.slow
def test_springs_on_a_users_brain_are_sealed_verified_and_mapped_back(job: synth.Job, tmp_path: Path) -> None:
    own_mechanics.main(tmp_path / "out", job)
    report = verify_dataset(tmp_path / "out")
    assert report.good, report.lines()
    assert {check.name for check in report.checks if check.skipped} >= {"compliance", "contact"}
    sequence = Dataset(tmp_path / "out")[0]
    assert {"energy_mn_mm", "min_jacobian", "residual"}.isdisjoint(sequence.attrs["mechanics"])
    assert sequence.attrs["mechanics"]["instruments"] == []
    assert not sequence["tool"][:].any()
    # All springs together: E / depth times the dent's volume over a flat surface, 2 pi width^2 dent.
    dents_mm = sequence["force"][:] / sequence.attrs["young_kpa"] * DEPTH_MM / (2 * np.pi * WIDTH_MM**2)
    assert np.linalg.norm(dents_mm, axis=1).max() == pytest.approx(0.75 * DENT_MM, rel=0.1)
    # Depth of the rest frame in the coordinates of the file: points of the ellipsoid but for its triangles.
    view, tissue, depth = optics.camera_of(sequence), sequence["tissue"][:], sequence["depth"][0]
    points = cameras.rays(view, cameras.pixel_grid(view.size)) * depth.reshape(-1, 1)
    world = (points[tissue.ravel()] - view.translation) @ view.rotation
    from_world = np.linalg.inv(sequence.attrs["mesh_to_world"])
    positions = (world @ from_world[:3, :3].T + from_world[:3, 3]) / [32.0, 26.0, 22.0]
    assert np.abs(np.linalg.norm(positions, axis=1) - 1).max() < 0.04


def test_a_pulse_alone_moves_the_surface_without_force(job: synth.Job) -> None:
    pulse = Pulse(0.3, 1.2, 0.2, 0.5, 0.3, 1.0)
    scene = synth.simulate(job, case=draw_bare_scenario(job, pulse))
    centre = np.hypot(*scene.shape.vertices[:, :2].T) < 2.5
    rise = scene.motion.displacement[:, centre, 2].mean(axis=1)
    assert rise == pytest.approx(pulse.height(scene.time), rel=0.1, abs=0.01)
    assert not scene.motion.traction.any()
    assert scene.motion.tip.shape == (4, 0, 3)
    rest_motion = synth.simulate(job, case=draw_bare_scenario(job)).motion
    assert not rest_motion.displacement.any()


WRONG: dict[str, Callable[[synth.Deformation], Any]] = {
    "displacement": lambda deformation: deformation.displacement[:, :-1],
    "traction": lambda deformation: 1e-3 * deformation.traction,  # MPa
    "force": lambda deformation: deformation.force[1:],
    "tip": lambda deformation: np.zeros((4, 2, 3)),
    "energy": lambda deformation: np.full(4, np.nan),
    "residual": lambda deformation: [0.0] * 4,
}


@pytest.mark.parametrize("name", [*WRONG, "rest", "single"])
def test_an_invalid_result_is_refused_by_name(job: synth.Job, name: str) -> None:
    class Wrong(Springs):
        def deform(self, rest: synth.RestScene, *_: object) -> synth.Deformation:
            deformation = super().deform(rest)
            if name == "rest":
                return replace(deformation, displacement=deformation.displacement + 0.01)
            if name == "single":
                return replace(deformation, displacement=deformation.displacement.astype(np.float32))
            return replace(deformation, **{name: WRONG[name](deformation)})

    with pytest.raises(synth.UserError, match=name if name in WRONG else "displacement"):
        synth.simulate(job, case=draw_bare_scenario(job), mechanics=Wrong())


def test_as_many_instruments_as_gestures_are_expected(job: synth.Job) -> None:
    with pytest.raises(synth.UserError, match="tip"):
        synth.simulate(job, mechanics=Springs())


@pytest.mark.slow
def test_content_of_ones_own_is_drawn_around_the_same_surface(job: synth.Job) -> None:
    def remove_instruments(rest: RestScene) -> synth.SceneContent:
        return replace(draw_craniotomy(rest), instruments=None)

    scene = synth.simulate(job)
    bare_scene = synth.simulate(job, content=remove_instruments)
    frame, bare_frame = scene.frame(2), bare_scene.frame(2)
    assert frame.tool.any()
    assert not bare_frame.tool.any()
    np.testing.assert_array_equal(frame.flow, bare_frame.flow)
