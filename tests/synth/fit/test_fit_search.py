"""The search on statistics of a known law, without a renderer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from synth.fit import look_file, parameters, search
from synth.fit.candidate import Setting
from synth.fit.compression import Compression
from synth.fit.parameters import PARAMETERS, SPREAD
from synth.job.schema import Job

SETTING = Setting(0.0547, (0,), Compression())
TRUTH = parameters.start("pale") | {
    "density": 1.4,
    "calibre": 0.8,
    "vignette": 0.4,
    "noise": 2.0,
    "glare": 0.4,
}


def law(values: dict[str, float], steeper: float = 1.0) -> dict[str, float]:
    """Statistics that rise as the parameters say, or `steeper` than that, and bend."""
    found = {}
    for name in SPREAD:
        level = sum(
            one.effects.get(name, 0) * (one.onto(values[one.name]) - 0.1 * np.sin(one.onto(values[one.name])))
            for one in PARAMETERS
        )
        kind = parameters.SCALES.get(name, "log")
        level = steeper * level - (3 if kind == "share" else 0)
        found[name] = level if kind == "linear" else np.exp(level) - (0.003 if kind == "share" else 0)
    return found


def searched(
    monkeypatch: pytest.MonkeyPatch, theirs: dict[str, float], steeper: float, worst: float = 0.3
) -> search.Fitted:
    said: list[tuple[int, float]] = []
    given: dict[str, dict[str, float]] = {}

    def as_job(values: dict[str, float], family: str) -> dict[str, Any]:
        given["now"] = values
        return {}

    monkeypatch.setattr(search.parameters, "as_job", as_job)
    monkeypatch.setattr(search, "render", lambda *_: None)
    monkeypatch.setattr(search, "measured", lambda _: law(given["now"], steeper))
    found = search.search(theirs, SETTING, 25, lambda turn, at: said.append((turn, at)))
    assert [turn for turn, _ in said] == list(range(1, 26))
    assert found.distance == min(at for _, at in said) < worst * said[0][1]
    return found


@pytest.mark.parametrize("steeper", [0.7, 1.0, 1.4])
def test_parameters_are_found_though_the_slopes_are_wrong(
    monkeypatch: pytest.MonkeyPatch, steeper: float
) -> None:
    theirs = law(TRUTH, steeper)
    found = searched(monkeypatch, theirs, steeper)
    for name in ("density", "calibre", "vignette", "noise", "glare", "crown g", "vein b"):
        # What frames say little of is drawn a little to the family.
        close = 0.15 if name in ("density", "calibre") else 0.1
        assert found.values[name] == pytest.approx(TRUTH[name], rel=close), name
    assert found.left == () == found.bounded


def test_what_the_photograph_does_not_show_stays_the_familys(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = law(TRUTH)
    hidden = [name for name in theirs if name.split()[0] in ("vein", "wine") and name != "vein share"]
    found = searched(monkeypatch, theirs | dict.fromkeys(hidden, np.nan), 1.0)
    assert set(found.left) == set(hidden)
    assert found.values["vein r"] == parameters.start(found.family)["vein r"]


def test_a_parameter_at_its_limit_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = law(TRUTH | {"glare": -1.6})
    found = searched(monkeypatch, theirs, 1.0, worst=0.8)
    assert "glare" in found.bounded
    assert found.values["glare"] == -1
    assert found.values["density"] == pytest.approx(TRUTH["density"], rel=0.15)


def test_what_is_far_off_arrives_in_few_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise has a figure of its own: that it is many spreads off mustn't shorten its steps."""
    theirs = law(TRUTH | {"noise": 5.0})
    said: list[float] = []
    given: dict[str, dict[str, float]] = {}
    monkeypatch.setattr(search.parameters, "as_job", lambda values, _: given.update(now=values) or {})
    monkeypatch.setattr(search, "render", lambda *_: None)
    monkeypatch.setattr(search, "measured", lambda _: law(given["now"]))
    found = search.search(theirs, SETTING, 4, lambda _, at: said.append(at))
    assert found.values["noise"] == pytest.approx(5, rel=0.15)
    assert found.values["vignette"] == pytest.approx(0.4, rel=0.15)


def test_what_a_picture_does_not_decide_is_named_and_what_it_shows_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    theirs = law(TRUTH)
    found = searched(monkeypatch, theirs, 1.0)
    assert {"wine r", "film_mm"} <= set(found.undecided)
    assert not {"crown r", "crown g", "noise"} & set(found.undecided)
    small = searched(monkeypatch, theirs | {"noise": np.nan}, 1.0)
    assert "noise" not in small.unsure, "nothing is said of it: it is among those left as the family's"


def test_deviations_are_those_of_repeated_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a Monte Carlo of the statistics' own spread, for a parameter that other ones trade against."""
    rng = np.random.default_rng(0)
    at = parameters.start("healthy")
    told = list(PARAMETERS)
    names = list(SPREAD)
    slopes = np.array([[one.effects.get(name, 0.0) for one in told] for name in names])
    spread = np.array([SPREAD[name] for name in names])
    home = np.diag([1 / one.vague for one in told])
    matrix = np.concatenate([slopes / spread[:, None], home])
    true = rng.normal(size=(4000, len(told))) * [one.vague for one in told]
    seen = true @ slopes.T + spread * rng.normal(size=(4000, len(names)))
    given = np.concatenate([seen / spread, np.zeros((4000, len(told)))], axis=1)
    off = np.linalg.lstsq(matrix, given.T, rcond=None)[0].T - true
    theirs = law(at)
    expected = search._unsure(told, theirs, 10**9)
    np.testing.assert_allclose(off.std(axis=0), list(expected.values()), rtol=0.06)


@pytest.mark.parametrize("family", parameters.FAMILIES)
def test_each_family_is_nearest_to_itself_as_frames_show_it(family: str) -> None:
    at = parameters.start(family)
    seen = {"g": 0.83, "b": 0.74, "r": 1.0}
    theirs = {f"{name} {k}": seen[k] * at[f"{name} {k}"] for name in ("crown", "flush") for k in "rgb"}
    assert search.nearest_family(theirs) == family


def test_what_is_brighter_than_tissue_is_a_longer_exposure() -> None:
    values = parameters.start("healthy")
    values = values | {
        f"{c} {k}": 2 * values[f"{c} {k}"] for c in ("crown", "flush", "vein", "wine") for k in "rgb"
    }
    sections = parameters.as_job(values, "healthy")
    longer = sections["sensor"]["exposure"][0] / parameters.EXPOSURE
    assert longer == pytest.approx(2, rel=0.01)
    assert max(sections["appearance"]["own"]["crown"]) == pytest.approx(0.95)
    assert longer * sections["appearance"]["own"]["vein"][1] == pytest.approx(values["vein g"])


def test_fewer_highlights_than_beside_the_lens_are_lamps_farther_away() -> None:
    beside, far = (
        parameters.as_job(parameters.start("pale") | {"glare": g}, "pale")["light"] for g in (0.2, -0.5)
    )
    assert beside["glare"] == [0.2, 0.2]
    assert "tilt_deg" not in beside
    assert far["glare"] == [0, 0]
    assert far["tilt_deg"] == [21.5, 21.5]


def test_blur_below_nothing_is_sharpening() -> None:
    soft = parameters.as_job(parameters.start("healthy") | {"blur": 1.5}, "healthy")["sensor"]
    sharp = parameters.as_job(parameters.start("healthy") | {"blur": -0.5}, "healthy")["sensor"]
    assert (soft["blur_px"], sharp["blur_px"]) == (1.5, 0)
    assert sharp["sharpening"][0] - soft["sharpening"][0] == pytest.approx(0.5)


def test_the_file_is_a_job_with_these_values() -> None:
    from synth.job import reader

    fitted = search.Fitted(
        "calf",
        parameters.start("calf") | {"density": 1.3},
        {},
        0.2,
        ("vein r", "vein g"),
        ("glare",),
        {"wine r": 0.5, "wine g": 0.2, "crown r": 0.1, "blur": 0.3},
    )
    written = look_file.text(fitted, look_file.sections(fitted, "4:2:0", 6.5), ["Fitted to x.jpg."])
    job = reader.parse_job(written, "look.yaml", reader.Path.cwd())
    assert isinstance(job, Job)
    assert job.appearance.families == ("calf",)
    assert job.appearance.own.crown == (0.81, 0.64, 0.5)
    assert job.anatomy.vessel_density == 1.3
    assert (job.sensor.chroma, job.sensor.bitrate_mbps) == ("4:2:0", 6.5)
    low, high = job.appearance.own.arterial or (0, 0)
    assert low < 0.8 < high
    assert written.splitlines()[:4] == [
        "# Fitted to x.jpg.",
        "# Not to be seen in it, as the family calf has them: vein.",
        "# At a limit, look at the picture: glare.",
        "# Not decided by this picture, one standard deviation: wine 65%, blur 0.30.",
    ]
