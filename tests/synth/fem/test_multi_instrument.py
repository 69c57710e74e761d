"""Several instruments at once: room, independent gestures, labels that add up; loads given as force."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dome import ANATOMY, block, patch
from pydantic import ValidationError

from synth.errors import UserError
from synth.fem import equilibrium, multi_instrument, solver
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.system import System, assemble
from synth.fem.tool import Gesture
from synth.job import reader, schema
from synth.render.camera import camera
from synth.render.scene import Studio
from synth.sequence import pipeline, scenario

TISSUE = Tissue(1.0, 0.4, "neo-hookean")


def drawn(fem: schema.Fem, seed: int) -> tuple[Gesture, ...]:
    rng = np.random.default_rng(seed)
    first = Gesture.draw(fem, ANATOMY.craniotomy, TISSUE, rng)
    return (first, *multi_instrument.further(first, fem, ANATOMY.craniotomy, TISSUE, rng))


@pytest.mark.parametrize("count", [2, 3])
def test_instruments_leave_each_other_room_and_do_things_of_their_own(count: int) -> None:
    several = [drawn(schema.Fem(instruments=count), seed) for seed in range(20)]
    for gestures in several:
        assert len(gestures) == count
        for k, one in enumerate(gestures):
            for other in gestures[:k]:
                assert multi_instrument.room(one, other) >= 0
                apart = min(
                    np.linalg.norm(np.subtract(p.point_mm, q.point_mm))
                    for p in one.contacts
                    for q in other.contacts
                )
                assert apart > 0.5 * (one.footprint_mm + other.footprint_mm)
                assert one.timing != other.timing
                assert one.direction != other.direction
    assert any(len({g.kind for g in gestures}) > 1 for gestures in several)


def test_how_many_there_are_is_drawn_from_the_range() -> None:
    counts = {len(drawn(schema.Fem(instruments=(1, 3)), seed)) for seed in range(20)}
    assert counts == {1, 2, 3}


def test_an_opening_without_room_is_an_error() -> None:
    fem = schema.Fem(instruments=3, footprint_mm=30.0)
    with pytest.raises(UserError, match="have no room in an opening of 12 mm"):
        drawn(fem, 0)


def test_what_is_loaded_keeps_within_what_is_asked() -> None:
    wide = ANATOMY.craniotomy.model_copy(update={"radius_mm": 24.0})

    def furthest(fem: schema.Fem) -> float:
        ends = []
        for seed in range(40):
            rng = np.random.default_rng(seed)
            first = Gesture.draw(fem, wide, TISSUE, rng)
            for gesture in (first, *multi_instrument.further(first, fem, wide, TISSUE, rng)):
                starts = np.array([contact.point_mm for contact in gesture.contacts])
                places = np.concatenate([starts, starts + gesture.path_mm])
                ends.append(np.hypot(*places.T).max() + gesture.footprint_mm)
        return float(max(ends))

    assert 10 < furthest(schema.Fem(instruments=(1, 2), within_mm=14.0)) <= 14
    assert furthest(schema.Fem(instruments=(1, 2))) > 18
    with pytest.raises(UserError, match=r"opening of 24 mm radius and fem.within_mm of 7"):
        furthest(schema.Fem(instruments=2, within_mm=7.0, footprint_mm=3.0, gestures=("push",)))
    with pytest.raises(UserError, match=r"fem.within_mm: a slide of .* which 4 mm leave no room for"):
        furthest(schema.Fem(gestures=("slide",), within_mm=4.0))


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_labels_of_two_instruments_add_up_and_both_touch(law: str) -> None:
    fem = schema.Fem(law=law, tets=400, load=(0.1, 0.15), instruments=2, gestures=("pull", "push"))
    gestures, frames = drawn(fem, 3), 17
    tissue = Tissue(1.0, 0.4, law)
    tets, surface = block(fem), patch()
    motion = solver.deform(fem, tissue, gestures[0], tets, *surface, frames, 25.0, gestures[1:])
    assert motion.tip.shape == motion.shaft.shape == (frames, 4, 3)
    assert motion.by_instrument.shape == (frames, 2, 3)
    np.testing.assert_allclose(motion.by_instrument.sum(axis=1), motion.force, atol=1e-12)
    moved = motion.rest + motion.displacement
    for k, gesture in enumerate(gestures):
        centre = np.asarray(gesture.contacts[0].point_mm)
        mine = np.linalg.norm(motion.rest[:, :2] - centre, axis=1) < 1.1 * gesture.footprint_mm
        theirs = (
            np.linalg.norm(motion.rest[:, :2] - gestures[1 - k].contacts[0].point_mm, axis=1)
            < gestures[1 - k].footprint_mm
        )
        if not (mine & theirs).any():
            part = np.einsum("v,tvd->td", motion.area[mine], motion.traction[:, mine])
            np.testing.assert_allclose(part, motion.by_instrument[:, k], atol=1e-9)
        pressed = np.linalg.norm(motion.by_instrument[:, k], axis=1)
        apart = np.linalg.norm(motion.tip[:, 2 * k : 2 * k + 2, None] - moved[:, None], axis=3).min(axis=2)
        assert apart[pressed > 0.05 * pressed.max()].max() < 0.6  # half a vertex spacing
        assert apart[0].min() > 3
    if law == "linear":
        alone = [solver.deform(fem, tissue, g, tets, *surface, frames, 25.0).displacement for g in gestures]
        np.testing.assert_allclose(motion.displacement, sum(alone), atol=1e-8)


def test_a_linear_scene_is_solved_once_for_each_direction_of_load(monkeypatch: pytest.MonkeyPatch) -> None:
    solved = []
    solve = System.solve
    monkeypatch.setattr(System, "solve", lambda self, force: solved.append(1) or solve(self, force))
    tets = tetrahedra.block(ANATOMY, 400, 2)
    system = assemble(tets, "linear", 0.4)
    one, other = np.random.default_rng(0).normal(size=(2, *tets.points.shape))
    share = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.3], [0.2, 1.0], [0.0, 0.1]])
    loads = 1e-3 * np.einsum("tk,knd->tnd", share, np.stack([one, other]))
    moved = equilibrium.solve_path(system, loads, np.full(5, 0.1)).displacement
    assert len(solved) == 2
    for u, load in zip(moved, loads, strict=True):
        np.testing.assert_allclose(u, solve(system, load), atol=1e-10)


@pytest.mark.slow
def test_the_picture_shows_every_instrument_where_its_load_is() -> None:
    whole = schema.Job(
        seed=2,
        frames=5,
        anatomy=schema.Anatomy(vertices=2500),
        fem=schema.Fem(tets=400, load=(0.1, 0.1), instruments=2, gestures=("pull", "push")),
        render=schema.Render(size=(160, 120), spp=1, tilt_deg=0.0),
    )
    case = scenario.draw(whole, 0)
    surface, tets = pipeline.build(whole, case)
    motion = pipeline.move(whole, case, surface, tets)
    view = camera.place(case.view, whole.render)
    studio = Studio(surface, case.look, view, whole, [gesture.kind for gesture in case.gestures])
    t = int(np.linalg.norm(motion.by_instrument, axis=2).min(axis=1).argmax())
    moved = motion.rest + motion.displacement[t]
    shown = np.argwhere(studio.frame(moved, motion.tip[t], motion.shaft[t], 0).tool)[:, ::-1]
    for gesture in case.gestures:
        mine = np.linalg.norm(motion.rest[:, :2] - gesture.contacts[0].point_mm, axis=1).argmin()
        place = camera.project(view, moved[[mine]])[0]
        reach = 0.5 * gesture.spread_mm + 1.0  # two tips stand on either side of the contact's centre
        assert np.linalg.norm(shown - place, axis=1).min() * view.mm_per_px < reach


def test_a_force_takes_the_place_of_the_load() -> None:
    fem = schema.Fem(force_mn=(3.0, 5.0), young_kpa=(2.0, 3.0), footprint_mm=(3.0, 4.0))
    assert fem.largest_load == pytest.approx(5.0 / 18)
    for seed in range(20):
        tissue = Tissue.draw(fem, np.random.default_rng(seed))
        gesture = Gesture.draw(fem, ANATOMY.craniotomy, tissue, np.random.default_rng(seed))
        force = np.linalg.norm(gesture.contacts[0].force_mn)
        assert 3.0 <= force <= 5.0
        assert force == pytest.approx(gesture.load * tissue.young_kpa * gesture.footprint_mm**2)
    assert Tissue.draw(schema.Fem(force_mn=0.2), np.random.default_rng(0)).law == "linear"


@pytest.mark.parametrize(("law", "limit"), [("linear", 0.2), ("corotational", 0.2), ("auto", 0.4)])
def test_a_force_past_the_laws_range_is_refused_with_the_largest_valid_one(law: str, limit: float) -> None:
    ranges = {"young_kpa": (0.5, 3.0), "footprint_mm": (3.0, 6.0)}
    largest = limit * 0.5 * 9.0
    with pytest.raises(ValidationError, match=rf"largest valid value is {largest:g}"):
        schema.Fem(law=law, force_mn=(1.0, 100.0), **ranges)
    fem = schema.Fem(law=law, force_mn=largest, **ranges)  # the value named is accepted
    tissue = Tissue(0.5, 0.4, "neo-hookean" if law == "auto" else law)
    gesture = Gesture.draw(
        fem.model_copy(update={"footprint_mm": (3.0, 3.0)}),
        ANATOMY.craniotomy,
        tissue,
        np.random.default_rng(0),
    )
    assert gesture.load == pytest.approx(limit)
    solver.check_load(tissue.law, gesture.load)


def test_a_job_file_says_both_ways_and_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text("fem: {force_mn: 500}\n")
    with pytest.raises(UserError, match=r"force_mn 500 .*largest valid value is 1\.8"):
        reader.load_job(str(path))
    path.write_text("fem: {law: linear, load: [0.1, 0.5]}\n")
    with pytest.raises(UserError, match=r"load 0\.5 .*largest valid value is 0\.2"):
        reader.load_job(str(path))
    path.write_text("fem: {force_mn: 1.8}\n")
    assert reader.load_job(str(path)).fem.force_mn == (1.8, 1.8)
