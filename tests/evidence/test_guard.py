"""The guard sees what changes values, and nothing else."""

import ast
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sources import ROOT

import synth
from evidence import result_status, study
from evidence.guard import guard, probes
from evidence.guard.guard import Change
from evidence.guard.probes import PROBES
from evidence.guard.sketch import compare, compare_all, sketch, sketch_all
from synth.fem.pulse import Pulse
from synth.sequence import fem_mechanics

NEUTRAL = (
    "synth/system",
    "synth/dataset",
    "synth/publish",
    "synth/checks",
    "synth/engine",
    "synth/tune",
    "synth/fit",
)
"""Packages that pass values on, or whose values no study stores."""
LONG = "network", "score", "score-stereo", "wide-tissue", "pulse"
"""Probes of trainings, of whole scores, of many tissues."""


@pytest.fixture(scope="module")
def truth() -> dict[str, Any]:
    return probes.probe_truth()


@pytest.fixture(scope="module")
def picture() -> dict[str, Any]:
    return probes.probe_picture()


def change(probe: str, before: dict[str, Any], now: dict[str, Any]) -> Change:
    differences = compare_all(sketch_all(before), sketch_all(now))
    array = max(differences, key=lambda name: differences[name])
    return Change(probe, differences[array], array)


FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sign": lambda values: -values,
    "axes": lambda values: values[..., [1, 0, *range(2, values.shape[-1])]],
    "mirror": lambda values: values[:, :, ::-1],
    "shift of a pixel": lambda values: np.roll(values, 1, axis=2),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["flow", "traction", "motion"])
def test_a_fault_of_a_label_moves_the_probe(name: str, fault: str, truth: dict[str, Any]) -> None:
    assert not change("truth", truth, truth).moved
    assert change("truth", truth, truth | {name: FAULTS[fault](truth[name])}).moved


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["mirror", "shift of a pixel"])
def test_a_fault_of_a_picture_moves_the_probe(fault: str, picture: dict[str, Any]) -> None:
    name = "stereo: left"
    assert change("picture", picture, picture | {name: FAULTS[fault](picture[name])}).moved


@pytest.mark.slow
def test_more_stiffness_and_a_lost_pulse_move_the_mechanics(monkeypatch: pytest.MonkeyPatch) -> None:
    before = probes.probe_mechanics()
    equations = fem_mechanics.solver.deform

    def stiffen(fem: Any, tissue: Any, *rest: Any, **options: Any) -> synth.Deformation:
        return equations(fem, replace(tissue, young_kpa=1.01 * tissue.young_kpa), *rest, **options)

    with monkeypatch.context() as patch:
        patch.setattr(fem_mechanics.solver, "deform", stiffen)
        assert change("mechanics", before, probes.probe_mechanics()).moved
    with monkeypatch.context() as patch:
        patch.setattr(Pulse, "height", lambda self, time: np.zeros(len(time)))
        pulse_change = change("mechanics", before, probes.probe_mechanics())
    assert pulse_change.moved
    assert pulse_change.array.startswith("pulse")


@pytest.mark.slow
def test_a_swapped_camera_moves_the_stereo_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    before, other = probes.probe_stereo(), {"frames": "right", "right": "frames"}
    read = probes._read_pictures
    monkeypatch.setattr(probes, "_read_pictures", lambda name, folder: read(name, other[folder]))
    assert change("stereo", before, probes.probe_stereo()).moved


@pytest.mark.trial
def test_comments_and_names_and_folders_are_not_seen(tmp_path: Path) -> None:
    """The same code without comments and docstrings, from another folder, gives the same sketches."""
    for package in ("synth", "learn", "bench", "evidence"):
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__", "*.nb?")
        )
    for path in [*(tmp_path / "synth/geometry").rglob("*.py"), *(tmp_path / "synth/fem/mesh").rglob("*.py")]:
        path.write_text("# a comment\n" + ast.unparse(ast.parse(path.read_text("utf-8"))))
    program = "import json; from evidence.guard.guard import run_probe; print(json.dumps(run_probe('mesh')))"
    result = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    now = json.loads(result.stdout)
    assert not guard.compare({"mesh": guard.read_sketches()["mesh"]}, {"mesh": now})[0].moved


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.trial] * (name in LONG)) for name in PROBES]
)
def test_a_probe_is_as_stored(name: str, request: pytest.FixtureRequest) -> None:
    """Or `make guard ACCEPT=1`, after its version was raised, says what this change moves."""
    fixture = name in ("truth", "picture")
    sketches = sketch_all(request.getfixturevalue(name)) if fixture else guard.run_probe(name)
    (outcome,) = guard.compare(guard.read_sketches(), {name: sketches})
    assert not outcome.moved, outcome.text()


def test_a_sketch_estimates_the_size_of_a_change() -> None:
    rng = np.random.default_rng(0)
    values, noise = rng.normal(size=(2, 4000))
    errors = [compare(sketch(f"{k}", values), sketch(f"{k}", values + 0.01 * noise)) for k in range(20)]
    assert np.median(errors) == pytest.approx(0.01, rel=0.3)
    assert compare(sketch("a", values), sketch("a", values[::-1])) > 0.5
    assert compare(sketch("a", values), sketch("a", values[:-1])) == np.inf
    assert compare(sketch("a", 0 * values), sketch("a", values)) == np.inf
    assert compare(sketch("a", 0 * values), sketch("a", 0 * values)) == 0
    with pytest.raises(ValueError, match="finite"):
        sketch("a", [np.nan])


def test_a_moved_probe_needs_a_raised_version() -> None:
    versions = guard.versions()
    moved, still = Change("flow", 0.5, "flow"), Change("flow", 1e-3, "flow")
    assert guard.find_unraised([moved], versions, versions)
    assert not guard.find_unraised([moved], versions, versions | {"MOTION": versions["MOTION"] + 1})
    assert guard.find_unraised([moved], versions, versions | {"MESH": versions["MESH"] + 1})
    assert not guard.find_unraised([still], versions, versions)
    assert guard.read_versions() == versions, "raised without `make guard ACCEPT=1`, or not stored"


def test_a_result_says_what_has_moved_since(tmp_path: Path) -> None:
    today = guard.read_sketches()
    other = json.loads(json.dumps(today["flow"]))
    other["flow"]["projections"] = [-value for value in other["flow"]["projections"]]
    results = {
        "stands": {"needs": {"mesh": today["mesh"]}},
        "moved": {"needs": {"mesh": today["mesh"], "flow": other}},
        "old": {"commit": "abc"},
        "gone": {"needs": {"no such probe": {}}},
    }
    for name, result in results.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text(json.dumps(result))
        (tmp_path / name / "README.md").write_text("# Title\n\nText.\n")
    states = {state.file.parent.name: state for state in result_status.gather(tmp_path)}
    assert {name: state.stands for name, state in states.items()} == dict.fromkeys(results, False) | {
        "stands": True
    }
    assert [moved_probe.probe for moved_probe in states["moved"].moved] == ["flow"]
    for _ in range(2):  # the line is replaced, not repeated
        result_status.write_states(tmp_path)
        for name, state in states.items():
            text = (tmp_path / name / "README.md").read_text()
            assert text == f"# Title\n\n*State: {state.describe()}.*\n\nText.\n"


def test_a_result_from_before_a_probe_of_its_study_does_not_stand(tmp_path: Path) -> None:
    entry = study.load("fem.loads")
    file = tmp_path / entry.result
    file.parent.mkdir(parents=True)
    complete = result_status.stamp(entry.needs)
    file.write_text(json.dumps(complete))
    (state,) = result_status.gather(tmp_path)
    assert (state.stands, state.missing) == (True, ())
    del complete["needs"][entry.needs[-1]]
    file.write_text(json.dumps(complete))
    (state,) = result_status.gather(tmp_path)
    assert (state.stands, state.missing) == (False, entry.needs[-1:])


def test_pages_state_whether_their_results_stand(tmp_path: Path) -> None:
    for state in result_status.gather():
        page = state.file.with_name("README.md")
        assert f"*State: {state.describe()}.*" in page.read_text("utf-8"), "python -m evidence status --write"


@pytest.mark.parametrize("name", [name for name in study.names() if study.load(name).result])
def test_a_study_needs_probes_of_all_that_it_imports(name: str) -> None:
    path = ROOT / "evidence" / f"{name.replace('.', '/')}.py"
    covered_packages = [package for probe in study.load(name).needs for package in PROBES[probe].packages]
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for module in modules:
            place = module.replace(".", "/")
            if (
                not place.startswith(("synth/", "learn/", "bench/"))
                or not (ROOT / place).with_suffix(".py").exists()
            ):
                continue
            inside = place.count("/") == 1 or place.startswith((*covered_packages, *NEUTRAL))
            assert inside, f"{name} imports {module}, which none of its probes covers"
