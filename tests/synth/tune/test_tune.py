"""Tuning: the force is read in its unit, the search keeps its budget, the file is the person's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job
from synth.tune import measurements, parameters, probe, search, tuned_job
from synth.tune.measurements import Measurements
from synth.tune.probe import Measured, Probe

SMALL: dict[str, Any] = {
    "seed": 5,
    "sequences": 1,
    "frames": 4,
    "anatomy": {"vertices": 2500},
    "fem": {"tets": 600, "load": 0.1, "law": "neo-hookean", "gestures": ["pull"]},
    "render": {"size": [128, 96], "spp": 2},
}
JOB = Job.model_validate({"seed": 1, "fem": {"gestures": ["pull"]}})


@pytest.mark.slow
def test_a_tenth_more_load_reads_as_a_tenth_more_force() -> None:
    job = Job.model_validate(SMALL)
    one = Probe(job)
    found = one.measure(job)
    assert np.abs(found.label).max() < 1e-4
    assert np.isfinite(found.read).all()
    assert (found.cost > 0).all()
    # What flow alone changes is no matter of the label, and needs no other pictures.
    other = one.measure(parameters.changed(job, {"flow.backend": "dis"}))
    np.testing.assert_array_equal(other.label, found.label)
    assert other.cost[:3].tolist() == found.cost[:3].tolist()
    more = one.measure(parameters.changed(job, {"fem.load": [0.11, 0.11]}))
    # The reading's own mesh is another one, and the tangent a straight line: a tenth within a sixth of it.
    assert more.label.max() == pytest.approx(0.1, rel=0.16)


class Fake:
    """A probe whose errors are known: what parameters do adds up, but for a surprise in cheap pictures."""

    asked = 0

    def __init__(self, job: Job) -> None:
        pass

    def measure(self, job: Job) -> Measured:
        Fake.asked += 1
        label = {4000: 0.0, 2500: 0.005, 1600: 0.01, 800: 0.2}[job.fem.tets]
        small = job.render.size[0] / 640
        read = label + 0.02 * (1 - small) + {8: 0.0, 4: 0.002, 2: 0.03}[job.render.spp]
        if small < 0.5 and job.render.spp < 8:
            read += 0.05
        cost = [job.fem.tets / 1000, 2.0, small * job.render.spp / 8, small**2]
        return Measured(np.full((2, 1), label), np.full((2, 1), read), np.array(cost))


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements, "Probe", Fake)
    monkeypatch.setattr(Fake, "asked", 0)


@pytest.fixture
def tuned(fake: None, tmp_path: Path) -> search.Tuned:
    return search.tune(Measurements(JOB, tmp_path / "part"), 0.03, 2, 1)


def test_a_prediction_that_does_not_hold_is_given_up(tuned: search.Tuned) -> None:
    assert len(tuned.tried) > 1
    assert tuned.tried[0].error > 0.03  # the surprise
    assert tuned.best is tuned.tried[-1]
    assert tuned.best.error <= 0.03
    assert tuned.best.cost < 0.65 * tuned.own.cost
    assert len(tuned.best.errors) == 3
    mesh = next(one for one in tuned.alone if one.name == "fem.tets 2500")
    assert mesh.error == pytest.approx(0.005)


def test_a_job_within_the_budget_is_better_than_full_fidelity(
    fake: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Where nothing cheaper keeps the budget, the job stays as it was."""

    def wrong(*_: Any, **__: Any) -> search.Evaluation:
        cheap = {one.key: one.settings[-1] for one in parameters.list_parameters(JOB)}
        return search.Evaluation("", cheap, (0.0,), (0.0,), 0.0)

    monkeypatch.setattr(search, "_pick", wrong)
    tuned = search.tune(Measurements(JOB, tmp_path / "part"), 0.03, 1, 0)
    assert tuned.best is tuned.own
    assert tuned.changes == {}


def test_a_stopped_run_goes_on(fake: None, tmp_path: Path) -> None:
    path = tmp_path / "part"
    first = search.tune(Measurements(JOB, path), 0.03, 1, 1)
    whole, asked = path.read_text(), Fake.asked
    lines = whole.splitlines()
    path.write_text("\n".join(lines[:-2]) + "\n" + lines[-2][:30])  # killed while it wrote
    again = search.tune(Measurements(JOB, path), 0.03, 1, 1)
    assert Fake.asked == asked + 2
    assert again == first
    search.tune(Measurements(parameters.changed(JOB, {"seed": 2}), path), 0.03, 1, 1)
    assert Fake.asked == 2 * asked + 2  # of another job nothing is taken


def test_settings_that_cannot_be_carried_out_are_never_chosen(
    fake: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    measure = Fake.measure

    def refuse(self: Fake, job: Job) -> Measured:
        if job.fem.tets == 1600:
            raise UserError("inverted")
        return measure(self, job)

    monkeypatch.setattr(Fake, "measure", refuse)
    tuned = search.tune(Measurements(JOB, tmp_path / "part"), 0.03, 1, 0)
    assert np.isinf(tuned.own.error)
    assert tuned.best.settings["fem.tets"] in (2500, 4000)
    assert any("fails" in line for line in tuned_job.table(tuned))


def test_what_settings_take_of_the_budget() -> None:
    still, full = np.zeros((2, 1)), np.array([[0.03], [-0.03]])
    assert search.excess(still, -2 * full, full) == pytest.approx(0.03)  # size counts, not sign
    assert search.excess(still, 0.1 * full, full) == 0  # reading better pays for nothing
    assert search.excess(0.5 * full, 0.1 * full, full) == pytest.approx(0.015)  # but the label moved
    assert search.size(np.array([[0.03, 0.04]])) == pytest.approx(0.05)  # of instruments, squares add up


def test_the_written_job_is_the_persons_own(tuned: search.Tuned, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    source, out = tmp_path / "job.yaml", folder / "tuned.yaml"
    source.write_text(
        "seed: 1  # mine\nfem:\n  gestures: [pull]  # only these\nrender:\n  spp: 4\n"
        "appearance:\n  photo: cortex.jpg\n"
    )
    (tmp_path / "cortex.jpg").touch()
    before = reader.load_job(str(source), ["frames=12"])
    tuned_job.write(tuned, str(source), ["frames=12"], out)
    text = out.read_text()
    assert "# mine" in text
    assert "# only these" in text
    assert tuned.changes
    assert reader.load_job(str(out)) == parameters.changed(before, tuned.changes)
    with pytest.raises(FileExistsError):
        tuned_job.write(tuned, str(source), [], out)


@pytest.mark.parametrize("text", ["3", "force 0%", "force 100%", "flow 3%", "force 3"])
def test_a_budget_that_is_none(text: str) -> None:
    with pytest.raises(UserError):
        search.parse_budget(text)


def test_parameters_follow_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    dynamic = parameters.list_parameters(
        Job.model_validate({"fem": {"time": "dynamic", "load": [0.05, 0.1]}})
    )
    physics = {"fem.law", "fem.tets", "fem.time"}
    pictures = {"anatomy.vertices", "render.size", "render.spp"}
    assert {one.key for one in dynamic} == physics | pictures
    monkeypatch.setattr(parameters, "CHEAPEST_FIRST", ("linear",))  # another's law is another tissue
    foreign = Job.model_validate({"fem": {"law": "neo-hookean", "load": [0.05, 0.1]}})
    assert "fem.law" not in [one.key for one in parameters.list_parameters(foreign)]
    ideal = parameters.list_parameters(Job.model_validate({"flow": {"backend": "ideal"}}))
    assert {one.key for one in ideal} == {"fem.tets"}


@pytest.mark.parametrize("name", ["paper", "in-vivo"])
def test_every_setting_is_a_job(name: str) -> None:
    job = reader.load_job(name)
    for one in parameters.list_parameters(job):
        assert one.own in one.settings
        for setting in one.settings:
            parameters.changed(job, {**one.base, one.key: setting})


def test_frames_lead_up_to_the_peak() -> None:
    class Motion:
        area = np.ones(2)
        traction = np.zeros((24, 2, 3))

    Motion.traction[4:, :, 2] = -np.minimum(np.arange(20), 10)[:, None]
    assert probe.loaded_frames(Motion) == (0, 7, 11, 14)  # type: ignore[arg-type]
