"""Settings as words and as files: presets changed from a command line, configurations read again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from learn.checkpoint import Card, read_card, write_card
from learn.data.grid import Scales
from learn.loss import Objective
from learn.network.d2fnet import Architecture
from learn.settings import Settings, override, preset, replace
from synth.errors import UserError

OLD = """
{"format": "sulcus-model", "version": 1, "settings": {"size": 32, "extent_mm": 36.0, "arch": {"name":
"d2fnet", "width": 16, "levels": 2, "stem": 2, "detail": false, "output": "magnitude", "bounds": [0.25,
0.75, 1.5], "dropout": 0.05, "confidence": false, "total": false, "condition": "none"}, "objective":
{"kind": "hinge", "r2_weight": 0.5, "r2_scope": "frame", "ghost_weight": 3.0, "low": 0.05, "rule":
"pixel", "stray_weight": 8.0, "stray_cap": 0.0, "ramp": [0.25, 0.75], "free": 0.01, "total_weight": 0.0,
"head_weight": 0.3}, "input": "mixed", "target": "density", "epochs": 24, "batch": 8, "learning_rate":
0.001, "weight_decay": 1e-05, "schedule": "cosine", "patience": 5, "stop": 0, "clip": 1.0, "augment":
true, "frames": 12, "precision": "32-true", "channels_last": true, "resident": "auto", "compile": false,
"deterministic": false, "folds": 5, "fold": 0, "held_out_family": "calf", "share_anatomy": false, "seed":
0}, "scales": {"displacement_mm": 0.5, "divergence": 0.02, "target": 0.3, "force": 12.5, "spread": 0.07},
"typical_young_kpa": 1.2, "split": {"fit": ["a1"], "select": ["b2"], "test": ["c3"]}, "groups": {"fit":
["seed-1"], "select": ["seed-2"], "test": ["seed-3"]}, "epoch": 7, "score": 0.71}
"""
"""config.json as `learn train` has written it since the first release of version 1."""


def test_a_model_folder_of_before_is_read_and_written_the_same(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(OLD)
    card = read_card(tmp_path)
    assert card == Card(
        Settings(
            size=32,
            arch=Architecture(width=16, stem=2, levels=2, output="magnitude", dropout=0.05),
            objective=Objective(kind="hinge", r2_weight=0.5, r2_scope="frame"),
            input="mixed",
            epochs=24,
            learning_rate=1e-3,
            schedule="cosine",
            channels_last=True,
            frames=12,
            held_out_family="calf",
        ),
        Scales(0.5, 0.02, 0.3, 12.5, 0.07),
        1.2,
        {"fit": ["a1"], "select": ["b2"], "test": ["c3"]},
        {"fit": ["seed-1"], "select": ["seed-2"], "test": ["seed-3"]},
        epoch=7,
        score=0.71,
    )
    write_card(tmp_path / "again", card)
    written = json.loads((tmp_path / "again/config.json").read_text())
    assert len(written.pop("seal")) == 32
    assert written.pop("weights_hash") == ""
    assert written == json.loads(OLD)


@pytest.mark.parametrize(
    "at", [(), ("settings",), ("settings", "arch"), ("settings", "objective"), ("scales",)], ids=".".join
)
def test_an_unknown_key_is_of_another_version_not_corrupt(at: tuple[str, ...], tmp_path: Path) -> None:
    tree = json.loads(OLD)
    block: dict[str, Any] = tree
    for key in at:
        block = block[key]
    block["heads"] = 3
    (tmp_path / "config.json").write_text(json.dumps(tree))
    named = ".".join((*at, "heads"))
    with pytest.raises(UserError, match=f"another version of this program .no '{named}' here.$"):
        read_card(tmp_path)


def test_settings_from_words() -> None:
    got = override(
        preset("tiny"), ["arch.width=8", "batch=3", "augment=false", "arch.bounds=1,2,3", "objective.low=0.1"]
    )
    assert (got.arch.width, got.batch, got.augment, got.arch.bounds) == (8, 3, False, (1.0, 2.0, 3.0))
    assert got.objective.low == 0.1
    assert replace(got, batch=8).arch.stem == preset("tiny").arch.stem


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("bacth=3", "'bacth=3': bacth: unknown key, did you mean 'batch'"),
        ("arch.widht=3", "'arch.widht=3': arch.widht: unknown key, did you mean 'width'"),
        ("width=3", "did you mean 'arch.width'"),
        ("batch", "batch: an override is written"),
        ("batch=many", "'batch=many': batch: a whole number is needed, not 'many'"),
        ("augment=perhaps", "true or false is needed, not 'perhaps'"),
        ("arch=3", "a block of keys is needed, not 3"),
        ("arch.bounds=1,2", r"arch.bounds=.1,2.': arch.bounds\[2\]: the list has the wrong length"),
        ("batch=0", "batch: 0 is out of range, it must be >= 1"),
        ("schedule=step", "'step' is not one of 'plateau' or 'cosine'"),
        ("arch.stem=3", "a stem is 1, 2 or 4"),
        ("size=48", r"^input size 48 does not divide by 32 \(stem 4, 3 levels\)"),
    ],
)
def test_settings_that_cannot_be(change: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        override(preset("live"), [change])
