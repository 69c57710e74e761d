"""Another program's states as a sequence: sealed, verified, with the program's own motion and force."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from command import run
from fake_run import in_process
from pressed_block import PLACE, POISSON, STATES, STEP_S, YOUNG_KPA, solve, write
from scipy import ndimage

import synth
from synth.arrays import Floats
from synth.checks.verify import verify_dataset
from synth.cli import app
from synth.errors import Caution, UserError
from synth.job import identity
from synth.job.schema import Job
from synth.render.camera import camera
from synth.sequence.job_series import read_job_series
from synth.sequence.pipeline import render_sequence
from synth.sequence.rest_scene import draw_craniotomy
from synth.system import series_files

SMALL = [
    "sequences=1",
    f"frames={STATES}",
    f"fps={1 / STEP_S}",
    "render.size=[96,72]",
    "anatomy.vertices=1500",
]
TISSUE = [f"fem.young_kpa={YOUNG_KPA}", f"fem.poisson={POISSON}", "mechanics.unit_mn=1"]
FORCE = [*TISSUE, "mechanics.force=nodal:contact"]


def make_job(source: Path, *changes: str) -> Job:
    files = [f"mechanics.source={source}", "mechanics.unit_mm=1", f"mechanics.dt_s={STEP_S}", PLACE]
    return synth.load_job("tiny", ["fem.load=[0.05,0.4]", "fem.tets=1600", *SMALL, *files, *changes])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("block"), "binary")


@pytest.mark.slow
def test_sequence_is_sealed_verified_and_has_the_engines_force(source: Path, tmp_path: Path) -> None:
    """One state per frame; then at twice the rate; the exported surface, rendered again, is the same."""
    in_process(make_job(source, *FORCE), tmp_path / "a", render_sequence)
    report = verify_dataset(tmp_path / "a")
    assert report.good, report.lines()
    sequence = synth.open_sequence(tmp_path / "a" / "000000.zarr")
    turn, expected = np.array(sequence.attrs["rotation"]), -solve().scale[:, None] * solve().reaction
    np.testing.assert_allclose(sequence["force"][:], expected @ turn.T, rtol=1e-4, atol=1e-4)
    assert {check.name: check.count for check in report.checks}["compliance"] == 1
    assert sequence.attrs["mechanics"]["law"] == "external"
    run(app, "export", tmp_path / "a", tmp_path / "vtu", "--to", "vtu")
    second_job = make_job(tmp_path / "vtu" / "000000.pvd", *FORCE, "mechanics.force=nodal:force")
    second_scene = synth.simulate(second_job, 0)
    np.testing.assert_allclose(second_scene.force, sequence["force"][:], rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_flow_is_the_projection_of_the_engines_nodes(source: Path) -> None:
    """Of a fine mesh, between whose nodes motion is smooth; without veins, which would stand out of it."""
    settings = ["anatomy.vertices=90000", "render.size=[240,180]", "flow.backend=ideal"]
    folder = write(source.parent / "fine", "npz", spacing_mm=1.5)
    scene = synth.simulate(make_job(folder, *FORCE, *settings), 0, content=draw_craniotomy)
    block, t, frame = solve(1.5), 2, scene.frame(2)
    top = np.isclose(block.points[:, 2], 0) & (np.hypot(*block.points[:, :2].T) < 8)
    assert scene.brain is not None
    turn, shift = scene.brain.to_world[:3, :3], scene.brain.to_world[:3, 3]
    rest, moved_points = (
        nodes[top] @ turn.T + shift for nodes in (block.points, block.points + block.scale[t] * block.u)
    )
    start = camera.project(scene.view, rest)
    expected = camera.project(frame.camera, moved_points) - start
    inside = ndimage.map_coordinates(scene.tissue.astype(float), start.T[::-1], order=1) == 1
    flow = [ndimage.map_coordinates(frame.flow[..., d], start.T[::-1], np.float64, order=3) for d in (0, 1)]
    error = np.linalg.norm(np.stack(flow, axis=1) - expected, axis=1)[inside]
    assert inside.sum() > 50
    assert np.linalg.norm(expected, axis=1).max() > 2
    assert np.median(error) < 1.5e-3
    assert error.max() < 1e-2


def test_frames_lie_between_states_and_other_axes_turn_the_result(source: Path, tmp_path: Path) -> None:
    plain_scene = synth.simulate(make_job(source, *FORCE), 0)
    double_scene = synth.simulate(
        make_job(source, *FORCE, f"frames={2 * STATES - 1}", f"fps={2 / STEP_S}"), 0
    )
    np.testing.assert_allclose(
        double_scene.motion.displacement[::2], plain_scene.motion.displacement, atol=1e-9
    )
    midpoints = (plain_scene.force[1:] + plain_scene.force[:-1]) / 2
    np.testing.assert_allclose(double_scene.force[1::2], midpoints, rtol=1e-6, atol=1e-6)
    with np.load(write(tmp_path, "npz")) as file:
        arrays = {
            name: values[..., [1, 2, 0]] if values.shape[-1] == 3 else values for name, values in file.items()
        }
    np.savez(tmp_path / "turned.npz", **arrays)
    place = "anatomy.craniotomy={point: [0, 0, 0], direction: [0, 1, 0], radius_mm: 10}"
    turned_scene = synth.simulate(make_job(tmp_path / "turned.npz", *FORCE, place), 0)
    sizes = [np.linalg.norm(force, axis=-1) for force in (turned_scene.force, plain_scene.force)]
    np.testing.assert_allclose(*sizes, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        turned_scene.motion.force[:, 2], plain_scene.motion.force[:, 2], rtol=1e-5, atol=1e-5
    )


def write_table(source: Path, name: str, tip: Floats) -> None:
    rows = [f"{STEP_S * k},{x},{y},{z},0,0,2" for k, (x, y, z) in enumerate(tip.tolist())]
    (source.parent / name).write_text("time,x0,y0,z0,u0,v0,w0\n" + "\n".join(rows) + "\n")


@pytest.mark.slow
def test_instruments_follow_their_table(source: Path) -> None:
    """The tip is where the load is, by the check of contacts in pixels; it hides the tissue under it."""
    tip = np.array([1.0, 0.0, 0.0]) + np.outer(solve().scale, [0.3, 0, -1.0])
    write_table(source, "tips.csv", tip)
    scene = synth.simulate(
        make_job(source, *FORCE, "mechanics.instruments=tips.csv", "fem.instrument=suction"), 0
    )
    assert scene.brain is not None
    turn, shift = scene.brain.to_world[:3, :3], scene.brain.to_world[:3, 3]
    np.testing.assert_allclose(scene.motion.tip[:, 0], tip @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(scene.motion.shaft[:, 1], np.broadcast_to(turn[:, 2], (STATES, 3)), atol=1e-9)
    np.testing.assert_allclose(scene.motion.by_instrument[:, 0], scene.motion.force)
    assert scene.frame(2).tool.any()


@pytest.mark.slow
def test_without_a_force_there_is_no_label_anywhere(source: Path, tmp_path: Path) -> None:
    job = make_job(source)
    with synth.open_dataset(tmp_path / "a", job) as folder:
        synth.write_scene(synth.simulate(job, 0), folder)
    assert verify_dataset(tmp_path / "a").good
    sequence = synth.open_sequence(tmp_path / "a" / "000000.zarr")
    assert not {"force", "traction"} & set(sequence.fields)
    assert sequence.attrs["young_kpa"] is None
    assert "peak_force_mn" not in sequence.attrs["summary"]
    for form, code in (("folder", 0), ("video", 0), ("endonerf", 0), ("d2fnet-npz", 2)):
        run(app, "export", tmp_path / "a", tmp_path / form, "--to", form, code=code)
    assert np.isnan(synth.simulate(make_job(source), 0).force).all()


@pytest.mark.slow
def test_doubts_are_stored_and_counted_and_a_replaced_series_is_refused(tmp_path: Path) -> None:
    """Two nodes that change places are named by render and verify; then another motion takes their place."""
    source = write(tmp_path / "block", "npz")
    with np.load(source) as file:
        arrays = dict(file)
    top = np.flatnonzero(np.isclose(arrays["rest"][:, 2], 0))
    order = top[np.linalg.norm(arrays["rest"][top], axis=1).argsort()][:2]
    places = (arrays["rest"] + arrays["displacement"][3])[order[::-1]]
    arrays["displacement"][3][order] = places - arrays["rest"][order]
    np.savez(source, **arrays)
    job, root = make_job(source, *FORCE, "sequences=2"), tmp_path / "out"
    summary = synth.render_job(job.model_copy(update={"sequences": 1}), root, workers=1)
    (doubt,) = (caution for caution in summary.cautions if caution.startswith("nodes"))
    assert all(str(word) in doubt for word in [*order.tolist(), "state 3"])
    assert summary.cautions[doubt] == [0]
    stored = synth.open_sequence(root / "000000.zarr").attrs["mechanics"]["cautions"]
    assert doubt in stored
    report = verify_dataset(root, fast=True)
    assert report.cautions[doubt] == [0]
    assert not report.verdict.startswith("good")
    np.savez(source, **{**arrays, "displacement": 0.9 * arrays["displacement"]})
    with pytest.raises(UserError, match="another job"):
        synth.render_job(job, root, workers=1)
    with pytest.warns(Caution, match="nodes"):
        scene = synth.simulate(job, 1)
    with pytest.raises(UserError, match="replaced"):
        synth.write_scene(scene, root)


def test_a_pull_is_doubtful_unless_the_instrument_can(source: Path) -> None:
    """A press upside down is a pull; the direction of the opening tells."""
    with np.load(write(source.parent / "pull", "npz")) as file:
        arrays = dict(file)
    arrays |= {name: -arrays[name] for name in ("displacement", "contact")}
    np.savez(source.parent / "pull/s.npz", **arrays)
    job = make_job(source.parent / "pull/s.npz", *FORCE)
    assert any("upside down" in caution for caution in read_job_series(job, 0).cautions)
    write_table(source.parent / "pull/s.npz", "tips.csv", np.zeros((STATES, 3)))
    changes = ["mechanics.instruments=tips.csv", "fem.instrument=forceps"]
    job = make_job(source.parent / "pull/s.npz", *FORCE, *changes)
    assert not read_job_series(job, 0).cautions


def test_load_outside_the_opening_is_reported(source: Path) -> None:
    place = PLACE.replace("point: [0", "point: [10")
    with pytest.warns(Caution, match=r"force: .* mN, [3-7]\d%.* 0.00 mN"):
        scene = synth.simulate(make_job(source, *FORCE, place), 0)
    np.testing.assert_allclose(scene.motion.force[2], -solve().reaction, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        (["fem.membrane.probability=1"], "membrane"),
        (["fem.young_kpa=[1,2]"], "young_kpa"),
        (["anatomy.mesh=brain.obj"], "mesh"),
        (["frames=20"], "frames=5"),
        (["mechanics.source="], r"mechanics\.dt_s"),
        (["mechanics.force=", "store.extra=[intensity]"], "intensity"),
    ],
)
def test_a_job_that_does_not_suit_is_refused(changes: list[str], pattern: str, source: Path) -> None:
    (source.parent / "brain.obj").touch()
    with pytest.raises(UserError, match=pattern):
        synth.simulate(make_job(source, *FORCE, *changes), 0)


def test_files_enter_the_identity_by_content_and_folders_take_turns(tmp_path: Path) -> None:
    for name in ("run_a", "run_b"):
        write(tmp_path / name, "ascii")
    job = make_job(tmp_path / "run_*", *FORCE, "sequences=3")
    assert [path.name for path in series_files.list_sources(tmp_path / "run_*")] == ["run_a", "run_b"]
    old_identity, file = identity.identify_job(job), tmp_path / "run_b" / "block_3.vtu"
    (tmp_path / "elsewhere").mkdir()
    for name in ("run_a", "run_b"):
        (tmp_path / name).rename(tmp_path / "elsewhere" / name)
    moved_job = make_job(tmp_path / "elsewhere" / "run_*", *FORCE, "sequences=3")
    assert identity.identify_job(moved_job) == old_identity
    file = tmp_path / "elsewhere" / "run_b" / file.name
    file.write_text(file.read_text().replace("0.1", "0.2", 1))
    assert identity.identify_job(moved_job) != old_identity


@pytest.mark.parametrize("form", ["binary", "recorder", "npz"])
def test_new_writes_a_job_that_can_be_simulated(form: str, tmp_path: Path) -> None:
    source = write(tmp_path / "run_1", form)
    run(app, "new", tmp_path / "job.yaml", "--from-series", source)
    values = yaml.safe_load((tmp_path / "job.yaml").read_text())
    assert values["frames"] == STATES
    assert values["anatomy"]["craniotomy"]["point"] == pytest.approx([0, 0, 0], abs=3)
    scene = synth.simulate(synth.load_job(tmp_path / "job.yaml", ["anatomy.vertices=1500"]), 0)
    assert np.linalg.norm(scene.motion.displacement, axis=2).max() == pytest.approx(
        float(np.linalg.norm(solve().u, axis=1).max()), rel=0.1
    )
