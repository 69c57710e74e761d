"""The packages as scripts use them: imports are light, public names exist, the notebook runs."""

import ast
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from fake_model import write_model
from sources import ROOT, list_imports, parse, sources

import bench
import learn
import synth
from learn.data.grid import check_scale
from synth.dataset.store import Dataset

HEAVY = {"numpy", "pydantic", "torch", "mitsuba", "drjit", "scipy", "cv2", "zarr", "numba", "rich", "typer"}


@pytest.mark.parametrize(
    ("program", "light"),
    [
        ("import synth, learn, bench", HEAVY),
        ("import synth; synth.Job()", {"mitsuba", "drjit", "torch", "zarr", "numba"}),
        ("import synth.sequence.pipeline, synth.flow.recording.flow", {"torch"}),
        ("import synth.cli, learn.cli, bench.cli", {"torch", "numpy", "onnxruntime", "numba", "cv2"}),
        ("import synth, bench.scoring.score, bench.checks.check_recording, bench.tracking.live", {"torch"}),
        ("import synth, learn; learn.load_model('stereo')", {"torch", "onnx"}),
    ],
)
def test_importing_loads_only_what_it_needs(program: str, light: set[str]) -> None:
    program += "\nimport sys; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    modules = subprocess.check_output([sys.executable, "-c", program], cwd=ROOT, text=True).split()
    assert "synth" in modules
    assert not set(modules) & light


ESTIMATE = """
import numpy as np
from bench.cli import app
shape = (2, 48, 64)
np.savez("press.npz", flow=np.ones((*shape, 2)), tissue=np.ones(shape[1:]), scale_mm_per_px=0.5)
app(["estimate", "press.npz", "--membrane", "stripped", "--out", "out"], standalone_mode=False)
"""


@pytest.mark.parametrize(
    "program",
    [
        ESTIMATE,
        "from bench.cli import app; app(['score', '--help'], standalone_mode=False)",
        "from bench.cli import app; app(['check', '.'], standalone_mode=False)",
        pytest.param(
            "from synth.cli import app; app(['preview', 'tiny', '-n1', '-oa.png'], standalone_mode=False)",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["bench estimate", "bench score --help", "bench check", "synth preview"],
)
def test_only_training_imports_pytorch(program: str, tmp_path: Path) -> None:
    program = "import atexit, sys; atexit.register(lambda: print('torch' in sys.modules))\n" + program
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, env=environment
    )
    assert result.stdout.decode().split()[-1] == "False", result.stderr.decode()
    assert b"Traceback" not in result.stderr


def test_pytorch_is_imported_by_training_and_conversion_alone() -> None:
    """On import: functions that use the weights themselves import it when they are called."""
    apart = ("learn/training/", "learn/network/", "learn/inference/convert.py")
    for path in sources("synth", "learn", "bench"):
        top = [node for node in parse(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
        if "torch" in {name.split(".")[0] for name in list_imports(ast.Module(top, []))}:
            assert str(path.relative_to(ROOT)).startswith(apart)


@pytest.mark.parametrize("package", [synth, learn, bench])
def test_every_public_name_exists_and_is_documented(package: ModuleType) -> None:
    assert set(package.__all__) <= set(dir(package))
    assert all((getattr(package, name).__doc__ or "").strip() for name in package.__all__)


GREY = np.full((2, 40, 40, 3), 90, np.uint8)
FLOW, TISSUE = np.zeros((2, 40, 40, 2), np.float32), np.ones((40, 40), bool)


def predict_force(*inputs: Any) -> Any:
    """By a network with one camera."""
    with tempfile.TemporaryDirectory() as folder:
        return learn.predict_force(learn.load_model(write_model(Path(folder) / "model")), *inputs)


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("rate_hz", lambda: bench.Settings(rate_hz=0)),
        ("scale", lambda: check_scale(0.0)),
        ("flwo", lambda: synth.recover_flow(GREY, GREY[..., 0] > 0, GREY[0, ..., 0] < 0, "flwo")),
        ("frames", lambda: synth.recover_flow(GREY / 255, GREY[..., 0] > 0, GREY[0, ..., 0] < 0)),  # type: ignore[arg-type]
        ("tool", lambda: synth.recover_flow(GREY, GREY[0, ..., 0] > 0, GREY[0, ..., 0] < 0)),
        ("young_kpa", lambda: predict_force(FLOW, TISSUE, 0.1, math.nan)),
        ("flow", lambda: predict_force(FLOW * math.nan, TISSUE, 0.1)),
        ("tissue", lambda: predict_force(FLOW, TISSUE[0], 0.1)),
        ("confidence", lambda: predict_force(FLOW, TISSUE, 0.1, 1.0, FLOW)),
        ("scale", lambda: bench.estimate(GREY)),
        ("young_kpa", lambda: bench.estimate(GREY, scale_mm_per_px=0.1, tissue=TISSUE, young_kpa=-1.0)),
        ("tissue", lambda: bench.estimate(GREY, scale_mm_per_px=0.1, tissue=TISSUE[0])),
        ("rest_frame", lambda: bench.estimate(GREY, scale_mm_per_px=0.1, tissue=TISSUE, rest_frame=-1)),
        ("rest_frame", lambda: bench.estimate(GREY, scale_mm_per_px=0.1, tissue=TISSUE, rest_frame=99)),
    ],
)
def test_an_invalid_argument_is_refused_by_name(name: str, call: Callable[[], object]) -> None:
    with pytest.raises(synth.UserError, match=name):
        call()


@pytest.mark.slow
def test_a_model_estimates_force_and_the_bench_scores_it(out: Path, tmp_path: Path) -> None:
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
    # For unknown tissue the force is that of 1 kPa.
    np.testing.assert_allclose(unknown * about[2], force, rtol=1e-4, atol=1e-4)

    recording = bench.export_recording(sequence, tmp_path / "recording")
    methods = {"none": lambda frame, scene, picture: bench.ForceEstimate(np.zeros(3))}
    settings = bench.Settings(rate_hz=None)
    result = bench.score(recording, model, methods=methods, settings=settings, baselines=False)
    assert result.main == "D2FNet", "with baselines off, physics must not run"
    assert {"D2FNet", "none"} <= set(result.methods)
    assert result.methods["none"].scores["mae_mn"] == pytest.approx(np.abs(result.sensor_mn).mean(), rel=0.2)
    assert {path.name for path in tmp_path.iterdir()} == {"model", "recording"}, "scoring writes no files"
    assert bench.score(recording, settings=settings, baselines=False).main == "physics"


@pytest.mark.trial
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
    estimated, true = (np.linalg.norm(names[name], axis=1) for name in ("predicted", "applied"))
    assert estimated[0] == pytest.approx(0, abs=1e-6)
    assert np.corrcoef(estimated, true)[0, 1] > 0.8


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_examples_use_nothing_internal(path: Path) -> None:
    assert not re.search(r"^\s*(from|import) (synth|learn|bench)\.", path.read_text("utf-8"), re.M)
