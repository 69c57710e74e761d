"""What is kept is found again only by all that made it."""

from __future__ import annotations

from pathlib import Path

import pytest

from evidence import kept
from synth.dataset import provenance


def test_a_word_is_of_settings_data_and_code(monkeypatch: pytest.MonkeyPatch) -> None:
    here = kept.word("evidence.kept", {"epochs": 3, "ramp": (1, 2)}, ["a", "b"])
    assert kept.word("evidence.kept", {"ramp": [1, 2], "epochs": 3}, ["a", "b"]) == here
    others = [
        kept.word("evidence.kept", {"epochs": 4, "ramp": (1, 2)}, ["a", "b"]),
        kept.word("evidence.kept", {"epochs": 3, "ramp": (1, 2)}, ["b", "a"]),
    ]
    monkeypatch.setattr(kept, "code", lambda module: "another")
    others.append(kept.word("evidence.kept", {"epochs": 3, "ramp": (1, 2)}, ["a", "b"]))
    assert len({here, *others}) == 4


def test_a_result_is_computed_once_a_word(tmp_path: Path) -> None:
    asked: list[int] = []
    for key, value in (("a", 1), ("a", 2), ("b", 3)):
        kept.result(tmp_path, "x", key, lambda value=value: asked.append(value) or {"value": value})
    assert asked == [1, 3]
    assert kept.result(tmp_path, "x", "a", dict) == {"value": 1}


def tree(home: Path, **files: str) -> Path:
    for name, text in files.items():
        file = home / f"{name.replace('__', '/')}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        (file.parent / "__init__.py").touch()
        file.write_text(text)
    return home


def test_the_source_of_a_module_is_that_of_all_it_imports_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provenance, "_NO_PART", set())
    first = {
        "learn__train": "RATE = 1",
        "evidence__runs": "from learn.train import RATE",
        "evidence__page": "A = 1",
    }

    def word(**changed: str) -> str:
        home = tree(tmp_path / str(len(list(tmp_path.iterdir()))), **first | changed)
        return provenance.source(["evidence.runs"], kept.OURS, home)

    here = word()
    assert word(learn__train="RATE = 1  # remarked") == here
    assert word(evidence__page="A = 2") == here
    assert word(learn__train="RATE = 2") != here
    assert word(evidence__runs="from learn.train import RATE\nB = RATE") != here


@pytest.mark.slow
@pytest.mark.parametrize("module", ["learn.runs", "gap.runs", "end_to_end.pipelines"])
def test_training_and_scoring_are_counted(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted: set[str] = set()
    home = Path(provenance.__file__).parents[2]

    def code(at: Path, files: set[Path]) -> str:
        counted.update(str(file.relative_to(home)) for file in files)
        return ""

    monkeypatch.setattr(provenance, "_code", code)
    monkeypatch.setattr(provenance, "folder", lambda name: tmp_path)
    kept.code.__wrapped__(f"evidence.{module}")
    assert {"learn/training/train.py", "learn/loss.py", "synth/flow/tvl1.py"} <= counted
