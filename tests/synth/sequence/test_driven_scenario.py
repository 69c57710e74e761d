"""Driven instruments as jobs describe them: draws, refusals, and a scene with its label in the picture."""

import numpy as np
import pytest
from pydantic import ValidationError

from synth.fem import equilibrium
from synth.fem.deformation import Deformation
from synth.fem.tool_gesture import trajectory
from synth.job import reader
from synth.job.mechanics_sections import DRIVEN_SIZES_MM
from synth.job.schema import FemSection, Job
from synth.sequence.draw import draw_scenario
from synth.sequence.fem_mechanics import FemMechanics
from synth.sequence.rest_scene import RestScene
from synth.sequence.scenario import draw_gestures
from synth.sequence.simulation import simulate
from synth.system.stopwatch import StageCallback, Stopwatch

SMALL = {"sequences": 40, "frames": 9, "fps": 5.0, "anatomy": {"vertices": 3000}}


def make_job(**fem: object) -> Job:
    keys = {"contact": "driven", "travel_mm": [1, 3], "tets": 500, "law": "ogden", **fem}
    return Job.model_validate({**SMALL, "fem": keys, "render": {"size": [160, 120]}})


def test_sizes_ways_and_kinds_are_those_of_the_job() -> None:
    cases = [draw_scenario(reader.load_job("clinical"), index) for index in range(40)]
    assert {case.gestures[0].kind for case in cases} == {"retract", "push", "tap", "pull", "grasp"}
    assert 0.4 < np.mean([case.tissue.membrane is not None for case in cases]) < 0.9
    for case in cases:
        gesture = case.gestures[0]
        assert gesture.drive is not None
        assert gesture.drive.travel_mm is not None
        assert 0 < gesture.drive.travel_mm <= 12
        length, width = gesture.drive.size_mm
        assert length <= DRIVEN_SIZES_MM[gesture.instrument][0][1]
        assert width <= DRIVEN_SIZES_MM[gesture.instrument][1][1]
        assert -20 <= case.tissue.alpha <= -4.7
        assert gesture.reach_mm <= 18
        assert draw_scenario(reader.load_job("clinical"), case.index) == case


def test_a_named_way_or_force_is_kept() -> None:
    instrument = {"gesture": "pull", "instrument": "forceps", "place": [1, 0], "footprint_mm": 3}
    travel_gesture = draw_scenario(make_job(instrument_list=[instrument | {"travel_mm": 4}]), 0).gestures[0]
    assert travel_gesture.drive is not None
    assert (travel_gesture.drive.travel_mm, travel_gesture.drive.force_mn) == (4, None)
    assert travel_gesture.footprint_mm == pytest.approx(3)
    force_gesture = draw_scenario(make_job(instrument_list=[instrument | {"force_mn": 50}]), 0).gestures[0]
    assert force_gesture.drive is not None
    assert force_gesture.drive.travel_mm is None
    assert force_gesture.drive.force_mn == pytest.approx(50)


@pytest.mark.parametrize(
    "fem",
    [
        {"travel_mm": 1},
        {"contact": "driven"},
        {"contact": "driven", "travel_mm": 1, "force_mn": 5},
        {"contact": "driven", "travel_mm": 1, "gestures": ["slide"]},
        {"contact": "driven", "travel_mm": 1, "time": "dynamic"},
        {"contact": "driven", "travel_mm": 1, "instrument_list": [{"load": 0.1}]},
        {"contact": "driven", "travel_mm": 1, "instrument_list": [{"gesture": "slide"}]},
        {"contact": "driven", "instrument_list": [{"travel_mm": 1, "force_mn": 1}]},
        {"instrument_list": [{"travel_mm": 1}]},
        {"alpha": [-5, 5]},
        {"alpha": -60},
    ],
)
def test_what_does_not_go_together_is_refused(fem: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        FemSection.model_validate(fem)


def test_driven_contacts_take_the_law_that_stiffens_and_do_not_slide() -> None:
    fem = FemSection.model_validate({"contact": "driven", "travel_mm": 1})
    assert fem.chosen_law[0] == "ogden"
    assert "slide" not in fem.gestures


def test_a_draw_that_fails_is_drawn_anew_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    original = FemMechanics.deform

    def deform(self: FemMechanics, rest: RestScene, report: StageCallback, watch: Stopwatch) -> Deformation:
        if rest.scenario.attempt < 6:
            raise equilibrium.InvertedElement("too far")
        return original(self, rest, report, watch)

    monkeypatch.setattr(FemMechanics, "deform", deform)
    case = simulate(make_job(travel_mm=0.5), 1).scenario
    assert case.attempt == 6
    assert case.gestures != draw_scenario(make_job(travel_mm=0.5), 1).gestures


@pytest.mark.slow
def test_the_label_adds_up_to_the_reaction_in_the_picture() -> None:
    instrument = {"gesture": "retract", "instrument": "spatula", "place": [0, 0], "travel_mm": 3}
    instrument |= {"footprint_mm": 4, "direction": [1, 0, -0.2]}
    scene = simulate(make_job(instrument_list=[instrument]))
    frame = scene.frame(scene.strongest)
    force = np.linalg.norm(frame.force)
    assert force > 20
    total = (frame.traction * scene.area[..., None]).sum(axis=(0, 1), dtype=np.float64)
    assert np.linalg.norm(total - frame.force) <= 0.01 * force


def test_motions_of_the_job_for_flow_are_spread_evenly_over_decades() -> None:
    flow, pixels = reader.load_job("flow"), []
    for index in range(120):
        generators = [np.random.default_rng([index, k]) for k in range(3)]
        gesture = draw_gestures(flow.fem, 12.0, 1.0, *generators[:2], frames=flow.frames)[0]
        assert gesture.drive is not None
        assert gesture.drive.travel_mm is not None
        lateral_share = np.hypot(*gesture.direction[:2])
        per_mm = flow.render.size[0] / generators[2].uniform(*flow.render.field_mm)
        load = trajectory(gesture, flow.frames).load
        assert np.flatnonzero(load == 0).tolist() == [0, flow.frames - 1]
        pixels += (load[load > 0] * gesture.drive.travel_mm * lateral_share * per_mm).tolist()
    ends = [0.1, 1, 10, 80]
    share = np.histogram(pixels, ends)[0] / np.diff(np.log10(ends))
    assert np.abs(share / share.mean() - 1).max() < 0.2


def test_a_job_with_both_contacts_draws_each_in_half_of_the_sequences() -> None:
    """Forces and ways are as in jobs of one kind of contact; the law follows the contact."""
    fem = {"contact": ["loaded", "driven"], "travel_mm": [0.5, 2], "force_mn": [1, 3], "young_kpa": 2}
    job = Job.model_validate({"sequences": 80, "fem": fem})
    cases = [draw_scenario(job, index) for index in range(80)]
    driven_cases = [case for case in cases if case.gestures[0].drive is not None]
    loaded_cases = [case for case in cases if case.gestures[0].drive is None]
    assert 25 < len(driven_cases) < 55
    assert {case.tissue.law for case in driven_cases} == {"ogden"}
    assert "ogden" not in {case.tissue.law for case in loaded_cases}
    assert all(0 < case.gestures[0].drive.travel_mm <= 2 for case in driven_cases)  # type: ignore[union-attr, operator]
    assert all(
        1 <= case.gestures[0].force_mn <= 3.1 for case in loaded_cases if case.gestures[0].kind != "grasp"
    )
    assert "slide" in {case.gestures[0].kind for case in loaded_cases}
    assert "slide" not in {case.gestures[0].kind for case in driven_cases}


def test_driven_contacts_next_to_loaded_ones_need_their_way() -> None:
    with pytest.raises(ValidationError):
        FemSection.model_validate({"contact": ["loaded", "driven"], "force_mn": 3})


def test_one_kind_of_contact_is_stored_as_its_name() -> None:
    """As by versions that knew one kind only: a dataset that they began is still that job's."""
    driven_section = FemSection.model_validate({"contact": "driven", "travel_mm": 1})
    mixed_section = FemSection.model_validate({"contact": ["loaded", "driven"], "travel_mm": 1})
    for mode in ("python", "json"):
        assert driven_section.model_dump(mode=mode)["contact"] == "driven"
        assert FemSection().model_dump(mode=mode)["contact"] == "loaded"
        assert mixed_section.model_dump(mode=mode)["contact"] == ["loaded", "driven"]
    assert FemSection.model_validate(mixed_section.model_dump()).contact == ("loaded", "driven")


@pytest.mark.parametrize(
    "fem",
    [
        {"contact": ["loaded", "driven"], "gestures": ["slide"]},
        {"contact": ["driven", "driven"], "gestures": ["slide", "push"]},
        {"contact": ["loaded", "driven"], "instrument_list": [{"gesture": "slide"}]},
    ],
)
def test_no_driven_contact_slides(fem: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        FemSection.model_validate({"travel_mm": 1, **fem})


def test_of_both_kinds_forces_are_of_loaded_contacts_and_ways_of_driven_ones() -> None:
    instruments = [{"force_mn": 2, "footprint_mm": 4}, {"travel_mm": 1}]
    mixed_section = FemSection.model_validate(
        {"contact": ["loaded", "driven"], "travel_mm": 2, "instrument_list": instruments}
    )
    driven_section, loaded_section = mixed_section.of_contact("driven"), mixed_section.of_contact("loaded")
    assert [tool.force_mn for tool in driven_section.instrument_list] == [None, None]
    assert [tool.travel_mm for tool in driven_section.instrument_list] == [None, (1, 1)]
    assert loaded_section.instrument_list[0].force_mn == (2, 2)
