"""The packages as scripts use them: quick to import, with all that they promise, and the notebook runs."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rich.console
from fake_model import write_model
from rich.console import Console

import bench
import learn
import synth
from synth.dataset.store import Dataset
from synth.engine import progress
from synth.system import terminal

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("synth", "learn", "bench")
HEAVY = {"numpy", "pydantic", "torch", "mitsuba", "drjit", "scipy", "cv2", "zarr", "numba", "rich", "typer"}


def test_importing_loads_nothing_heavy() -> None:
    program = f"import sys, {', '.join(PACKAGES)}; print(*sorted(m.split('.')[0] for m in sys.modules))"
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    loaded = set(found.stdout.split())
    assert set(PACKAGES) <= loaded
    assert not loaded & HEAVY


def test_a_job_loads_no_renderer_and_no_torch() -> None:
    program = "import sys, synth; synth.Job(); print(*sorted({m.split('.')[0] for m in sys.modules}))"
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert {"pydantic"} <= set(found.stdout.split())
    assert not set(found.stdout.split()) & {"mitsuba", "drjit", "torch", "zarr", "numba"}


@pytest.mark.parametrize("name", PACKAGES)
def test_what_is_promised_is_there_and_types_say_the_same(name: str) -> None:
    package = importlib.import_module(name)
    stub = ast.parse((ROOT / name / "__init__.pyi").read_text("utf-8"))
    said = {
        alias.asname: (node.module, alias.name)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(said) == set(package.__all__)
    for public, (module, real) in said.items():
        found = getattr(package, public)
        assert public in dir(package)
        if public == "render":
            assert callable(found)
            continue
        assert found is getattr(importlib.import_module(str(module)), real)
        assert (found.__doc__ or "").strip(), public
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        getattr(package, "nothing_of_the_kind")  # noqa: B009


def test_the_room_render_can_be_called_however_it_was_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import synth.render.scene  # what overwrites the package's attribute

    said = []
    monkeypatch.setattr("synth.engine.render.run_job", lambda *given: said.append(given) or "summary")
    job = synth.Job()
    assert synth.render(job, tmp_path / "out", workers=1) == "summary"
    assert synth.render.scene.Studio
    (given,) = said
    assert given[:2] == (job, tmp_path / "out")
    assert given[2].workers == 1
    with pytest.raises(TypeError, match="sockets"):
        synth.render(job, tmp_path, sockets=3)


@pytest.mark.slow
def test_a_dataset_from_a_script(tmp_path: Path) -> None:
    small = ["sequences=1", "frames=2", "anatomy.vertices=2500", "fem.tets=400", "render.spp=1"]
    told: list[str] = []

    class Ear:
        def begin(self, total: int, already: int, failed: int) -> None:
            told.append(f"begin {total} {already} {failed}")

        def stage(self, index: int, stage: str, done: int, of: int) -> None:
            told.append(stage)

        def end(self, attempt: Any, again: bool) -> None:
            told.append(f"end {attempt.kind}")

        def account(self, account: Any) -> None:
            pass

    job = synth.load_job("tiny", small)
    summary = synth.render(job, tmp_path / "out", progress=Ear(), workers=1)
    assert (summary.done, summary.total, summary.failed) == (1, 1, {})
    assert told[0] == "begin 1 0 0"
    assert {"mesh", "fem", "render", "flow", "end done"} <= set(told)
    assert synth.render(job, tmp_path / "out").already == 1


def test_bars_are_drawn_in_a_notebook_that_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """As rich tells one: IPython's shell is there; it draws by way of ipywidgets."""
    monkeypatch.setattr(rich.console, "_is_jupyter", lambda: True)
    console = Console(stderr=True)
    assert console.is_jupyter
    assert not console.is_terminal
    monkeypatch.setattr(terminal, "find_spec", lambda name: None)
    assert not terminal.draws_bars(console)
    assert progress.Bars().disable, "plain lines instead"
    monkeypatch.setattr(terminal, "find_spec", lambda name: name == "ipywidgets" or None)
    assert terminal.draws_bars(console)
    assert not progress.Bars().disable


def test_a_model_reads_a_film_and_the_bench_scores_it(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_model(tmp_path / "model", "arch.output=vector")
    model = learn.load_model(str(folder))
    sequence = Dataset(out)[0]
    about = sequence["tissue"][:], sequence.attrs["scale_mm_per_px"], sequence.attrs["young_kpa"]
    flow = sequence["flow"][:]
    force = learn.predict_force(model, flow, *about)
    assert force.shape == (len(flow), 3)
    np.testing.assert_allclose(force[0], 0, atol=1e-9)
    assert np.isfinite(force).all()
    unknown = learn.predict_force(model, flow, *about[:2])
    np.testing.assert_allclose(unknown * about[2], force, rtol=1e-4, atol=1e-4), "then it is of 1 kPa"

    recording = bench.export_recording(sequence, tmp_path / "recording")
    own = {"none": lambda flow, confidence, scene, picture: bench.Answer(np.zeros(3))}
    every = bench.Settings(rate_hz=None)
    result = bench.score(recording, model, methods=own, settings=every, baselines=False)
    assert result.main == "D2FNet"
    assert {"D2FNet", "none"} <= set(result.methods)
    assert result.methods["none"].scores["mae_mn"] == pytest.approx(np.abs(result.sensor_mn).mean(), rel=0.2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model", "recording"], "nothing is written"
    assert bench.score(recording, settings=every, baselines=False).main == "D2FNet", "one that comes along"
    monkeypatch.setattr("learn.inference.shipped.MODELS", tmp_path / "none")
    with pytest.raises(synth.UserError, match="nothing to score"):
        bench.score(recording)
    with pytest.raises(synth.UserError, match="needs the model's folder"):
        bench.score(recording, model, train=out)


@pytest.mark.slow
def test_the_pages_shortest_program_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_model(tmp_path / "model", "arch.output=vector")
    page = (ROOT / "docs/reference/python.md").read_text("utf-8")
    names: dict[str, Any] = {}
    exec(page.partition("```python\n")[2].partition("```")[0], names)
    assert names["force"].shape == names["scene"].force.shape == (6, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = json.loads((ROOT / "examples" / "job_to_force.ipynb").read_text("utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert cells
    names: dict[str, Any] = {}
    for number, cell in enumerate(cells):
        exec(compile(cell, f"cell {number}", "exec"), names)
    assert names["recovered"].trusted.all()
    assert names["off_px"] < 0.5
    read, true = (np.linalg.norm(names[what], axis=1) for what in ("predicted", "applied"))
    assert read[0] == pytest.approx(0, abs=1e-6)
    assert np.corrcoef(read, true)[0, 1] > 0.8


def test_the_notebook_holds_no_output_and_uses_the_packages_alone() -> None:
    notebook = json.loads((ROOT / "examples" / "job_to_force.ipynb").read_text("utf-8"))
    for cell in notebook["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    source = "\n".join("".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code")
    assert not inner_imports(source)


def inner_imports(source: str) -> list[str]:
    """Modules below our packages that a program imports."""
    nodes = ast.walk(ast.parse(source))
    named = [
        name
        for node in nodes
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    ]
    return [name for name in named if name.split(".")[0] in PACKAGES and "." in name]


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_examples_use_nothing_internal(path: Path) -> None:
    assert not inner_imports(path.read_text("utf-8"))


def test_an_internal_import_is_seen() -> None:
    assert inner_imports("import synth\nfrom synth.fem import tool\nimport learn.loss") == [
        "synth.fem",
        "learn.loss",
    ]
