"""Pooled scores, and scores that can't be pooled."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from command import run

from bench.cli import app
from bench.scoring import pool
from bench.scoring.session_report import render_session, report_recordings
from evidence import pooled
from synth import formats
from synth.errors import UserError


def score(name: str, mae: float, specimen: str = "", **networks: str) -> dict[str, Any]:
    def method(value: float) -> dict[str, Any]:
        return {"scores": dict.fromkeys(pool.SCORES) | {"mae_mn": value, "r": 0.9}, "calibrated": {}}

    hashes = {network: {"hash": network_hash} for network, network_hash in networks.items()}
    methods = {"net": method(mae), "zero": method(4.0)} | {network: method(mae) for network in networks}
    settings = {"meta": {"specimen": specimen}, "networks": hashes}
    about = {"format": "sulcus-score", "format_version": 2, "recording": name, "main": "net", "frames": 10}
    return about | {"scores": {"mae_mn": mae}, "methods": methods, "settings": settings}


def store(folder: Path, tree: dict[str, Any]) -> Path:
    folder.mkdir()
    (folder / "score.json").write_text(json.dumps(tree))
    return folder


def test_means_and_intervals_over_specimens() -> None:
    tree = pool.pool([score("a", 1.0, "x"), score("b", 3.0, "x"), score("c", 5.0, "y")])
    net = tree["methods"]["net"]["scores"]["mae_mn"]
    assert net["mean"] == pytest.approx(3.0)
    assert (net["low"], net["high"]) == (None, None)  # too few specimens
    five = pool.pool([score(name, 1.0 + (name == "e"), name) for name in "abcde"])["methods"]["net"]["scores"]
    assert five["mae_mn"]["low"] < five["mae_mn"]["mean"] < five["mae_mn"]["high"]
    assert tree["methods"]["zero"]["main_worse_by_mn"]["mean"] == pytest.approx(-1.0)
    assert tree["methods"]["net"]["scores"]["ccc"]["mean"] is None
    assert tree["specimens"] == 2


def test_methods_are_identified_by_their_hash(tmp_path: Path) -> None:
    first = score("a", 1.0, net="x", one="y", two="z")
    tree = pool.pool([first, score("b", 3.0, net="x", other="y", two="w")])
    assert list(tree["methods"]) == ["net", "zero", "one"]  # called otherwise in b
    assert tree["methods"]["one"]["scores"]["mae_mn"]["mean"] == 2.0
    assert tree["of_some"] == ["two"]
    folders = [store(tmp_path / name, score(name, 1.0, net=network)) for name, network in ("ax", "by")]
    with pytest.raises(UserError, match=r"net of a.*net of b"):
        pool.read(folders)


ODD = {"lost": {"share": 0.3, "most": 0.2}}, {"fault": "it never changes"}, {"sync": {"refused": "ambiguous"}}


@pytest.mark.parametrize("odd", ODD)
def test_recordings_without_scores_are_not_pooled(odd: dict[str, Any], tmp_path: Path) -> None:
    scored_tree = score("a", 5.0) | {"lost": {"frames": 2, "share": 0.2, "most": 0.2}}
    tree = pool.pool([scored_tree, score("b", 1.0) | odd])
    assert list(tree["left_out"]) == ["b"]
    assert tree["methods"]["net"]["scores"]["mae_mn"]["mean"] == 5.0
    with pytest.raises(UserError):
        pool.read([store(tmp_path / "b", score("b", 1.0) | odd)])


def test_command_reads_folders_and_refuses_the_same_twice(tmp_path: Path) -> None:
    folders = [store(tmp_path / f"{name}-score", score(name, 2.0, name)) for name in "ab"]
    out = tmp_path / "out"
    run(app, "pool", *folders, "-o", out)
    assert {path.name for path in out.iterdir()} == {"pool.json", "README.md"}
    with pytest.raises(UserError, match="given twice"):
        pool.read([folders[0], folders[0]])
    with pytest.raises(UserError, match="no readable score"):
        pool.read([tmp_path])


def test_a_study_scores_recordings_once_for_each_version_of_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings, scored, fails = [tmp_path / name for name in "ab"], list[str](), False
    for recording in recordings:
        recording.mkdir()
        (recording / "meta.yaml").write_text("young_kpa: 1.0")

    def run_command(words: list[str]) -> subprocess.CompletedProcess[str]:
        name = Path(words[4]).name
        scored.append(name)
        if not fails:
            shutil.rmtree(tmp_path / f"{name}-score", ignore_errors=True)
            store(tmp_path / f"{name}-score", score(name, 2.0, name))
        return subprocess.CompletedProcess(words, 2 * fails)

    monkeypatch.setattr(pooled.subprocess, "run", run_command)
    for version in (1, 1, 2):
        monkeypatch.setattr(formats, "SCORING", version)
        pooled.score_and_pool(recordings, 1, tmp_path / "study")
    assert scored == ["a", "b", "a", "b"]
    (recordings[1] / "meta.yaml").write_text("young_kpa: 2.0")
    pooled.score_and_pool(recordings, 1, tmp_path / "study")
    assert scored[4:] == ["b"]
    assert json.loads((tmp_path / "study" / "pool.json").read_text())["recordings"] == ["a", "b"]
    (recordings[0] / "meta.yaml").write_text("young_kpa: 3.0")
    fails = True
    for _ in range(2):  # an old score is not taken for a new one
        with pytest.raises(UserError):
            pooled.score_and_pool(recordings, 1, tmp_path / "study")


def test_one_page_of_several_recordings_links_each_and_says_why_one_is_missing() -> None:
    findings = ["camera: moved", "x: y"]
    numbers = {"low_mn": 8.0, "high_mn": 17.0, "mae_of_peak": 0.071, "r": 0.98, "holds": 0.9}
    first = {"recording": "a b", "why": "", "findings": findings, "largest_mn": 12.0, "absolute": True}
    rows = [first | numbers, {"recording": "c", "why": "no <video>"}]
    page = render_session(rows, pool.pool([score("a b", 1.0, "x"), score("d", 3.0, "y")]))
    assert 'href="a%20b/report.html"' in page
    for text in ("12", "8 to 17", "7.1%", "camera: moved", "no &lt;video&gt;"):
        assert text in page
    assert "<video>" not in page
    assert "2.00" in page, "the mean over recordings"


def test_recordings_of_one_name_are_refused_before_any_is_scored(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a"):
        report_recordings([tmp_path / "x" / "a", tmp_path / "y" / "a"], tmp_path / "out", "")
    assert not (tmp_path / "out").exists()
    (row,) = report_recordings([tmp_path / "none"], tmp_path / "out", "")
    assert row["why"]
    assert (tmp_path / "out" / "report.html").is_file()
