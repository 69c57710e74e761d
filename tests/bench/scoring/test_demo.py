"""What `bench demo` may replace."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.scoring import demo as demos
from learn.inference.shipped import shipped
from synth.errors import UserError


def test_the_demo_replaces_its_own_recording_and_nobody_elses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def export(sequence: object, folder: Path) -> None:
        folder.mkdir()
        (folder / "meta.yaml").touch()

    monkeypatch.setattr(demos, "find_unseen", lambda dataset, model: type("", (), {"index": 0}))
    monkeypatch.setattr(demos, "export_recording", export)

    def demo() -> None:
        demos.export_unseen(tmp_path, [tmp_path], tmp_path / "recording")

    mine = tmp_path / "recording" / "operation.mp4"
    mine.parent.mkdir()
    mine.touch()
    with pytest.raises(UserError, match="not from `bench demo`"):
        demo()
    assert mine.exists()
    mine.unlink()
    mine.parent.rmdir()
    demo()
    (mine.parent / "old").touch()
    demo()
    assert not (mine.parent / "old").exists()
    assert (mine.parent / "meta.yaml").exists()


def test_the_network_that_comes_along_leads_and_the_trained_one_is_named_by_what_it_saw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demos, "Dataset", lambda dataset: [set()])
    main, others = demos.choose_networks(tmp_path, Path("stereo"))
    assert main == shipped()["mono"]  # the dataset has one eye
    assert others == {"trained on 1057 sequences": shipped()["stereo"]}
    assert demos.choose_networks(tmp_path, Path("mono")) == (main, {})
