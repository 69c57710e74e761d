"""What `bench demo` may replace."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.scoring import commands
from synth.errors import UserError
from synth.recording_flow.video_flow import Settings


def test_the_demo_replaces_its_own_recording_and_nobody_elses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def export(sequence: object, folder: Path) -> None:
        folder.mkdir()
        (folder / "meta.yaml").touch()

    monkeypatch.setattr(commands, "find_unseen", lambda dataset, model: type("", (), {"index": 0}))
    monkeypatch.setattr(commands, "export_recording", export)
    monkeypatch.setattr(commands, "score_recording", lambda *asked: None)

    def demo() -> None:
        commands.score_demo(tmp_path, tmp_path, tmp_path, Settings())

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
