"""Instruments as asked: where, what, how hard and when; the rest drawn, all of them named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_run import in_process

import synth
from synth.dataset.index import read_index
from synth.fem import multi_instrument
from synth.job import identity, writer
from synth.job.reader import parse_job
from synth.job.schema import Instrument
from synth.publish import contact_sheet
from synth.sequence import scenario
from synth.sequence.pipeline import render_sequence

PUSH = {
    "gesture": "push",
    "place": [4.0, 0.0],
    "direction": [0.0, 0.6, -0.8],
    "load": 0.1,
    "footprint_mm": 3.5,
    "timing": [0.1, 0.3, 0.6, 0.9],
}
PULL = {"gesture": "pull", "place": [-5.0, 1.0], "force_mn": 1.5, "direction": [0, 0, 2]}


def job(*crew: dict[str, Any], **fem: Any) -> synth.Job:
    return synth.Job.model_validate({"seed": 3, "sequences": 20, "fem": {"crew": crew, **fem}})


def test_what_is_asked_is_done_and_the_rest_is_drawn() -> None:
    asked = job(PUSH, PULL)
    cases = [scenario.draw(asked, index) for index in range(20)]
    for case in cases:
        push, pull = case.gestures
        assert (push.kind, push.point_mm, push.load, push.footprint_mm) == ("push", (4.0, 0.0), 0.1, 3.5)
        assert push.direction == pytest.approx((0.0, 0.6, -0.8))
        assert push.timing == (0.1, 0.3, 0.6, 0.9)
        assert push.force_mn == pytest.approx(0.1 * case.tissue.young_kpa * 3.5**2)
        assert (pull.kind, pull.point_mm, pull.direction) == ("pull", (-5.0, 1.0), pytest.approx((0, 0, 1)))
        assert pull.force_mn == pytest.approx(1.5)
        assert 3 <= pull.footprint_mm <= 6
        assert multi_instrument.room(push, pull) >= 0
    for drawn in ("azimuth_deg", "hover_mm"):
        assert len({getattr(case.gesture, drawn) for case in cases}) == 20
    assert len({case.further[0].timing for case in cases}) == 20


def test_an_instrument_alone_is_like_any_other_where_nothing_is_asked() -> None:
    plain, named = synth.Job(seed=3), job({})
    for index in range(3):
        assert scenario.draw(plain, index).gesture == scenario.draw(named, index).gesture
    held = job({"timing": [0.2, 0.4, 0.5, 0.6]})
    one, other = scenario.draw(plain, 0).gesture, scenario.draw(held, 0).gesture
    assert other.timing == (0.2, 0.4, 0.5, 0.6)
    assert (one.kind, one.point_mm, one.load) == (other.kind, other.point_mm, other.load)


def test_there_are_as_many_as_asked_or_more() -> None:
    counts = {len(scenario.draw(job(PUSH, instruments=(1, 3)), index).gestures) for index in range(20)}
    assert counts == {1, 2, 3}
    assert {len(scenario.draw(job(PUSH, {}), index).gestures) for index in range(5)} == {2}


def test_what_has_a_place_keeps_it_from_what_is_drawn() -> None:
    for index in range(20):
        drawn, placed = scenario.draw(job({}, {"place": [0, 0]}), index).gestures
        assert placed.point_mm == (0.0, 0.0)
        assert multi_instrument.room(drawn, placed) >= 0


@pytest.mark.parametrize("kind", ["slide", "grasp", "retract", "tap"])
def test_each_gesture_stays_inside_and_goes_its_way(kind: str) -> None:
    way = {"slide": [0, -1, 0], "grasp": [1, 0, 1], "retract": [1, 0, -0.2], "tap": [0, 0, -1]}[kind]
    asked = job({"gesture": kind, "place": [5.0, 0.0], "direction": way})
    for index in range(10):
        (gesture,) = scenario.draw(asked, index).gestures
        assert multi_instrument.fits(gesture, asked.anatomy.craniotomy)
        level = np.array(gesture.direction[:2])
        if kind == "slide":
            assert np.array(gesture.path_mm) / np.linalg.norm(gesture.path_mm) == pytest.approx([0, -1])
            assert gesture.direction[2] < 0
        elif kind == "tap":
            assert gesture.direction == pytest.approx((0, 0, -1))
        elif kind == "retract":
            assert gesture.direction == pytest.approx(np.array(way) / np.linalg.norm(way))
        else:
            assert level[0] > 0.5
            assert gesture.direction[2] > 0


WRONG = {
    "crew[0].place: 11 mm from the middle": {"place": [11, 0]},
    "a push points into the brain, z below 0": {"gesture": "push", "direction": [0, 0, 1]},
    "a pull points out of the brain, z above 0": {"gesture": "pull", "direction": [1, 0, 0]},
    "a slide needs x or y": {"gesture": "slide", "direction": [0, 0, -1]},
    "a retract goes aside": {"gesture": "retract", "direction": [0, 0, -1]},
    "direction needs gesture": {"direction": [0, 0, 1]},
    "either load or force_mn": {"load": 0.1, "force_mn": 1},
    "crew[0]: load 0.9 is past the range": {"load": 0.9},
    "crew[0]: force_mn 100 on the softest tissue": {"force_mn": 100},
    "must follow one another": {"timing": [0.5, 0.2, 0.6, 0.7]},
    "did you mean 'push'": {"gesture": "psh"},
    "did you mean 'place'": {"plcae": [1, 2]},
    "must be < 1": {"timing": [0.1, 0.2, 0.6, 1.0]},
}


@pytest.mark.parametrize("words", WRONG)
def test_bad_input_is_one_line(words: str) -> None:
    text = f"fem:\n  crew: [{writer.json.dumps(WRONG[words])}]\n"
    with pytest.raises(synth.UserError) as raised:
        parse_job(text, "job.yaml", Path())
    assert len(str(raised.value).splitlines()) == 1
    assert words in str(raised.value)
    assert str(raised.value).startswith("job.yaml:")


def test_what_no_draw_can_satisfy_is_one_line() -> None:
    with pytest.raises(synth.UserError, match=r"fem\.crew: instrument 1 has no room beside the other 1"):
        scenario.draw(job({"place": [1, 0]}, {"place": [-1, 0]}), 0)
    with pytest.raises(synth.UserError, match=r"instrument 0 has no room in an opening of 12 mm"):
        scenario.draw(job({"gesture": "slide", "place": [7.9, 0], "direction": [1, 0, 0]}), 0)


def test_a_rigid_tip_keeps_to_its_cone() -> None:
    steep = {"gesture": "push", "direction": [0, 0.19, -1]}
    assert job(steep, contact="rigid").fem.crew[0].direction == (0, 0.19, -1)
    with pytest.raises(ValueError, match=r"would slip off; at most 11\.3 degrees"):
        job(steep | {"direction": [0, 0.21, -1]}, contact="rigid")
    with pytest.raises(ValueError, match="name one in gestures"):
        job({"gesture": "pull"}, contact="rigid")


def test_its_loads_choose_the_law_and_are_the_largest() -> None:
    assert job({"load": 0.05}).fem.chosen_law[0] == "linear"
    assert job({"load": 0.05}, instruments=2).fem.chosen_law[0] == "neo-hookean"
    assert job({"load": 0.05}).fem.largest_load == 0.05


def test_a_job_file_with_a_crew_reads_back_and_counts() -> None:
    asked = job(PUSH, PULL)
    assert parse_job(writer.commented(asked), "job", Path()) == asked
    assert parse_job(writer.dump_job(asked), "job", Path()) == asked
    assert identity.identify_job(asked) != identity.identify_job(job(PUSH))
    assert identity.identify_job(synth.Job(seed=3, sequences=20)) == identity.identify_job(job())
    assert isinstance(asked.fem.crew[0], Instrument)


SMALL = {
    "seed": 3,
    "sequences": 1,
    "frames": 5,
    "anatomy": {"vertices": 2500},
    "fem": {"tets": 400, "young_kpa": 1.0, "crew": [PUSH, PULL | {"force_mn": 0.8, "footprint_mm": 3.0}]},
    "render": {"size": [64, 48], "spp": 1},
    "flow": {"backend": "ideal"},
}


@pytest.mark.slow
def test_both_load_the_tissue_and_everything_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = synth.Job.model_validate(SMALL)
    in_process(small, tmp_path, render_sequence)
    sequence = synth.Dataset(tmp_path)[0]
    first, second = sequence.attrs["mechanics"]["instruments"]
    turn = np.array(sequence.attrs["rotation"])
    forces = [np.array(one["force_mn"]) @ turn for one in (first, second)]  # world axes
    peaks = [force[np.linalg.norm(force, axis=1).argmax()] for force in forces]
    # Five frames needn't hold a peak itself; where it points they all do.
    for peak, way in zip(peaks, ([0, 0.6, -0.8], [0, 0, 1]), strict=True):
        np.testing.assert_allclose(peak / np.linalg.norm(peak), way, atol=1e-9)
    assert np.linalg.norm(peaks[0]) == pytest.approx(0.1 * 3.5**2, rel=1e-6)
    np.testing.assert_allclose(sum(forces) @ turn.T, sequence["force"][:], atol=1e-5)

    assert read_index(tmp_path)["gesture"].to_pylist() == ["push + pull"]
    card = (tmp_path / "README.md").read_text("utf-8")
    assert "push + pull 1" in card
    assert "2 gestures at once, as the job's `fem.crew` asks, on one anatomy" in " ".join(card.split())
    said: list[str] = []
    monkeypatch.setattr(contact_sheet.cv2, "putText", lambda picture, text, *more: said.append(text))
    contact_sheet.draw_sheet(small, 1)
    assert set(said) == {"0  healthy  push + pull"}
