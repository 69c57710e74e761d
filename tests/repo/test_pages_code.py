"""What the how-to pages show runs as it is pasted: their modules installed by their own entry points."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tiny_package
from fake_model import write_model

import bench
import synth
from synth.job.reader import parse_job
from synth.sequence import scenario

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
HOWTO = ROOT / "docs" / "howto"
SMALL = ["frames=3", "sequences=1", "anatomy.vertices=2500", "fem.tets=400", "render.spp=1"]


def blocks(page: str, language: str) -> dict[str, str]:
    """Fenced blocks of a page by title; those of one title in their order, as one text."""
    found: dict[str, str] = {}
    text = (HOWTO / page).read_text("utf-8")
    for title, inside in re.findall(rf'^```{language} title="(.*?)"\n(.*?)^```', text, re.M | re.S):
        found[title] = found.get(title, "") + inside
    return found


def pasted(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's package, installed from its blocks alone."""
    (module, code), *_ = [(k, v) for k, v in blocks(page, "python").items() if k.startswith("examples/")]
    project = tomllib.loads(blocks(page, "toml")["pyproject.toml"])["project"]
    assert project["name"].replace("-", "_") == Path(module).stem
    points = project["entry-points"]
    return tiny_package.install(folder, Path(module).stem, code, points, monkeypatch, project["version"])


def typed(page: str, words: str) -> list[str]:
    """The page's command line that begins so."""
    (line,) = re.findall(rf"^    ({words}.*)$", (HOWTO / page).read_text("utf-8"), re.M)
    return shlex.split(line)


def run(words: list[str], folder: Path, *paths: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, [*paths, ROOT]))}
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_law_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pasted("law.md", tmp_path / "site", monkeypatch)
    words = typed("law.md", "synth render")
    job = synth.load_job(words[2], [*words[5:], *SMALL])
    assert job.fem.law == "stiffening"
    scene = synth.simulate(job)
    assert np.linalg.norm(scene.force, axis=1).max() > 0
    (tmp_path / "try.py").write_text(blocks("law.md", "python")["try.py"])
    runpy.run_path(str(tmp_path / "try.py"))
    assert re.fullmatch(r"\d\.\d\d mm\n", capsys.readouterr().out)


def test_the_flow_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pasted("flow.md", tmp_path / "site", monkeypatch)
    words = typed("flow.md", "synth render")
    job = synth.load_job(words[2], [*words[5:], *SMALL])
    assert job.flow.backend == "farneback"
    scene = synth.simulate(job)
    seen = scene.recover_flow(list(scene.frames()))
    assert np.linalg.norm(seen.flow[scene.strongest], axis=2).max() > 0


def test_the_method_page(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pasted("method.md", tmp_path / "site", monkeypatch)
    monkeypatch.chdir(tmp_path)
    bench.export_recording(synth.Dataset(out)[0], tmp_path / "recordings" / "000000")
    (tmp_path / "score.py").write_text(blocks("method.md", "python")["score.py"])
    runpy.run_path("score.py")
    assert -1 <= float(capsys.readouterr().out) <= 1
    assert (tmp_path / "score" / "report.html").is_file()
    result = bench.score("recordings/000000", write_model(tmp_path / "model", "arch.output=vector"))
    assert {"D2FNet", "spring"} <= set(result.methods)


def test_the_instruments_page(capsys: pytest.CaptureFixture[str]) -> None:
    exec(blocks("instruments.md", "python")["crew.py"], {})
    assert capsys.readouterr().out.startswith("(0.0, 0.0) [")
    page = blocks("instruments.md", "yaml")["job.yaml"]
    case = scenario.draw(parse_job(page, "job.yaml", Path()), 0)
    assert [gesture.kind for gesture in case.gestures] == ["retract", "pull"]


def test_the_commands_of_the_pages(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for page, key, value in (("law", "mechanics", "stiffening"), ("flow", "flow_backend", "farneback")):
        site = pasted(f"{page}.md", tmp_path / page, monkeypatch)
        words = typed(f"{page}.md", "synth render")
        words[words.index("out")] = f"out-{page}"
        run([*words, *SMALL], tmp_path, site)
        (sequence,) = synth.Dataset(tmp_path / f"out-{page}")
        assert value in str(sequence.attrs[key])
    site = pasted("method.md", tmp_path / "method", monkeypatch)
    bench.export_recording(synth.Dataset(out)[0], tmp_path / "recordings" / "000000")
    write_model(tmp_path / "model", "arch.output=vector")
    run(typed("method.md", r"bench score recordings"), tmp_path, site)
    assert "spring" in (tmp_path / "score" / "report.html").read_text("utf-8")
