"""Tuning: the force error has its unit, the search keeps budget and cost, the file is the person's own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job
from synth.system import cache
from synth.tune import search
from synth.tune.probe import Probe
from synth.tune.search import Measurements, Tuned

JOB = Job.model_validate({"seed": 1, "fem": {"gestures": ["pull"]}})


@pytest.mark.slow
def test_a_tenth_more_load_is_an_error_of_a_tenth() -> None:
    fem = {"tets": 600, "load": 0.1, "law": "neo-hookean", "gestures": ["pull"]}
    sizes = {"anatomy": {"vertices": 2500}, "render": {"size": [128, 96], "spp": 2}}
    job = Job.model_validate({"seed": 5, "sequences": 1, "frames": 4, "fem": fem, **sizes})
    probe = Probe(job)
    label, *others = probe.measure(job)
    assert label < 1e-4
    assert 0 < min(others) < max(others) < np.inf
    assert probe.measure(search.change_job(job, {"flow.backend": "dis"}))[0] == label
    assert probe.measure(search.change_job(job, {"fem.load": [0.11, 0.11]}))[0] == pytest.approx(
        0.1, rel=0.05
    )


class FakeProbe:
    """A probe whose errors are known: what parameters do adds up, but for a surprise."""

    calls, refused, scale = 0, 0, 1.0

    def __init__(self, job: Job) -> None:
        self.scale = FakeProbe.scale * (1 + 0.01 * (job.seed % 7))

    def measure(self, job: Job) -> list[float]:
        FakeProbe.calls += 1
        if job.fem.tets == FakeProbe.refused:
            raise UserError("inverted")
        label = {4000: 0.0, 2500: 0.005, 1600: 0.01, 800: 0.012}[job.fem.tets]
        small = job.render.size[0] / 640
        recovered = label + 0.02 * (1 - small) + {8: 0.0, 4: 0.002, 2: 0.03}[job.render.spp]
        recovered += 0.05 * (small < 0.6 and job.fem.tets < 1600)
        cost = [job.fem.tets / 1000, 2.0, small * job.render.spp / 8, small**2]
        return [self.scale * label, self.scale * recovered, *cost]


@pytest.fixture(autouse=True)
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "Probe", FakeProbe)
    monkeypatch.setattr(cache, "folder", lambda _: tmp_path)
    for name, value in (("calls", 0), ("refused", 0), ("scale", 1.0)):
        monkeypatch.setattr(FakeProbe, name, value)


def tune(probes: int = 2, checks: int = 1, budget: float = 0.03, job: Job = JOB) -> Tuned:
    """The answer, with what holds of every one asserted."""
    tuned = search.tune(Measurements(job), budget, probes, checks)
    lines = search.lines(tuned)
    assert not any("nan" in line or "inf" in line for line in lines)
    assert any("this job" in line for line in lines)
    assert tuned.best.growth <= budget or tuned.best is tuned.original
    if tuned.original.growth - tuned.original.margin <= budget:
        assert tuned.best.stages.sum() <= tuned.original.stages.sum()
    return tuned


def test_a_prediction_that_does_not_hold_is_given_up() -> None:
    tuned = tune()
    first, *_, last = tuned.rows[tuned.rows.index(tuned.original) + 1 :]
    assert first.growth > 0.03  # the surprise
    assert tuned.best is last
    assert last.stages.sum() < 0.85 * tuned.original.stages.sum()
    assert len(last.growths) == 3


def test_a_job_gets_dearer_only_if_it_surely_misses_the_budget() -> None:
    short_search = tune(probes=1, checks=0, budget=0.003)  # over it, but of one sequence nothing is sure
    assert short_search.original.growth > 0.003
    assert short_search.best is short_search.original
    long_search = tune(probes=2, checks=2, budget=0.003)
    assert long_search.original.growth - long_search.original.margin > 0.003
    assert long_search.best.stages.sum() > long_search.original.stages.sum()
    assert long_search.best.stages.sum() < long_search.full.stages.sum()


def test_a_stopped_run_goes_on(tmp_path: Path) -> None:
    first, calls = search.lines(tune()), FakeProbe.calls
    missing, corrupted, *_ = tmp_path.glob("*.json")
    missing.unlink()
    corrupted.write_text(corrupted.read_text()[:-4])
    assert search.lines(tune()) == first
    assert FakeProbe.calls == calls + 2
    tune(job=search.change_job(JOB, {"seed": 2}))
    assert FakeProbe.calls >= 2 * calls  # of another job nothing is taken


@pytest.mark.parametrize("refused", [800, 1600, 2500])
def test_settings_that_cannot_be_carried_out_are_never_chosen(refused: int) -> None:
    FakeProbe.refused = refused
    tuned = tune()
    assert tuned.best.settings["fem.tets"] != refused
    assert any("cannot be carried out" in line for line in search.lines(tuned))
    FakeProbe.refused = 4000  # full fidelity
    with pytest.raises(UserError, match="inverted"):
        tune(job=search.change_job(JOB, {"seed": 2}))


@pytest.mark.parametrize("scale", [0.0, 1.0])  # of errors: none at all, and some
def test_nothing_to_choose(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    FakeProbe.scale = scale
    tune(job=search.change_job(JOB, {"flow.backend": "ideal"}))
    monkeypatch.setattr(search, "list_settings", lambda _: {})  # a single setting of everything
    assert tune(probes=1, checks=0).best.settings == {}


def test_the_written_job_is_the_persons_own(tmp_path: Path) -> None:
    tuned = tune()
    source, out = tmp_path / "job.yaml", tmp_path / "other" / "tuned.yaml"
    out.parent.mkdir()
    source.write_text("fem:\n  gestures: [pull]  # mine\nappearance:\n  photo: cortex.jpg\n")
    (tmp_path / "cortex.jpg").touch()
    source_job = reader.load_job(str(source), ["frames=12"])
    search.write_job(tuned, str(source), ["frames=12"], out)
    assert "gestures: [pull]  # mine" in out.read_text()
    changes = search.differences(tuned.best.settings, tuned.original.settings)
    assert reader.load_job(str(out)) == search.change_job(source_job, changes)
    with pytest.raises(FileExistsError):
        search.write_job(tuned, str(source), [], out)


@pytest.mark.parametrize("text", ["3", "force 0%", "force 100%", "flow 3%", "force 3"])
def test_a_budget_that_is_none(text: str) -> None:
    with pytest.raises(UserError):
        search.parse_budget(text)


def test_the_grid_follows_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    def list_keys(**sections: Any) -> set[str]:
        return set(search.list_settings(Job.model_validate(sections)))

    light, flow = {"load": [0.05, 0.1]}, {"render.size", "render.spp"}
    assert list_keys(fem={**light, "time": "dynamic"}) == {"fem.law", "fem.tets", "fem.time", *flow}
    assert "anatomy.vertices" in list_keys(anatomy={"vertices": 20_000})
    assert list_keys(flow={"backend": "ideal"}) == {"fem.tets"}
    monkeypatch.setattr(search, "CHEAPEST_FIRST", ("linear",))  # another's law is another tissue
    assert "fem.law" not in list_keys(fem={**light, "law": "neo-hookean"})


@pytest.mark.parametrize("name", ["paper", "in-vivo"])
def test_every_setting_is_a_job(name: str) -> None:
    own_settings = Measurements(job := reader.load_job(name)).original
    for key, settings in search.list_settings(job).items():
        assert own_settings[key] in settings
        assert [search.change_job(job, {key: setting}) for setting in settings]
