"""TrainingSettings as words and as files: presets changed from a command line, configurations read again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from learn.checkpoint import ModelCard, _hash, read_card
from learn.data.grid import Scales
from learn.network.d2fnet import Architecture
from learn.settings import TrainingSettings, as_changes, override, preset
from synth.errors import UserError
from synth.job import identity, retired

SCALES = {"displacement_mm": 0.5, "divergence": 0.02, "target": 0.3, "force": 12.5, "spread": 0.07}
FRAMED = {
    **{"kind": "hinge", "r2_weight": 0.5, "r2_scope": "frame", "ghost_weight": 3.0, "low": 0.05},
    **{"rule": "pixel", "stray_weight": 8.0, "stray_cap": 0.0, "ramp": [0.25, 0.75], "free": 0.01},
    **{"total_weight": 0.0, "head_weight": 0.3},
}
PUBLISHED = FRAMED | {"kind": "antighost", "r2_weight": 0.3, "r2_scope": "batch"}


def old(folder: Path, objective: dict[str, Any], **changes: Any) -> ModelCard:
    """The card of a config.json as commit f047e99 wrote it, changed at dotted settings."""
    values = {**{key: one.default for key, one in retired.TRAINING.items()}, "arch.width": 16, **changes}
    settings: dict[str, Any] = {"size": 32, "objective": objective, "arch": {"levels": 2}}
    for key, value in values.items():
        *blocks, name = key.split(".")
        (settings[blocks[0]] if blocks else settings)[name] = value
    tree = {"format": "sulcus-model", "version": 1, "settings": settings, "scales": SCALES}
    tree |= {"typical_young_kpa": 1.2, "split": {"fit": ["a1"]}, "groups": {"fit": ["seed-1"]}, "epoch": 7}
    tree["seal"] = _hash(identity.canonical(tree))
    (folder / "config.json").write_text(json.dumps(tree))
    return read_card(folder)


@pytest.mark.parametrize(
    ("objective", "loss"),
    [
        (FRAMED, "ghostless"),
        (PUBLISHED, "antighost"),
    ],
)
def test_a_config_of_before_is_read_and_its_loss_has_a_name(
    tmp_path: Path, objective: dict[str, Any], loss: str
) -> None:
    card = old(tmp_path, objective)
    assert card.settings == TrainingSettings(size=32, arch=Architecture(width=16, levels=2), loss=loss)  # type: ignore[arg-type]
    assert (card.scales, card.epoch, card.retired) == (Scales(**SCALES), 7, {})


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("bacth=3", "'batch'"),
        ("arch.depth=true", "arch.depth"),
        ("arch.prior=residual", retired.LAST),
    ],
)
def test_settings_that_cannot_be(change: str, key: str) -> None:
    with pytest.raises(UserError, match=key):
        override(preset("live"), [change])


def test_settings_of_a_command_line_stand_anywhere_and_need_a_value() -> None:
    words = ["--epochs", "3", "data", "--seed=1", "loss=mse", "seed=2"]
    assert as_changes(words) == ({"epochs": "3", "seed": "2", "loss": "mse"}, ["data"])
    for broken in (["--compile", "--epochs", "3"], ["data", "--epochs"]):
        with pytest.raises(UserError):
            as_changes(broken)
