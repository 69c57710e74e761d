"""Training settings from a command line."""

from __future__ import annotations

import pytest

from learn.settings import as_changes, preset
from synth.errors import UserError
from synth.system.config_file import override


@pytest.mark.parametrize(("change", "key"), [("bacth=3", "'batch'"), ("arch.depth=true", "arch.depth")])
def test_invalid_settings_are_refused(change: str, key: str) -> None:
    with pytest.raises(UserError, match=key):
        override(preset("live"), [change])


def test_settings_may_stand_anywhere_and_need_a_value() -> None:
    words = ["--epochs", "3", "data", "--seed=1", "loss=mse", "seed=2"]
    assert as_changes(words) == ({"epochs": "3", "seed": "2", "loss": "mse"}, ["data"])
    for broken in (["--compile", "--epochs", "3"], ["data", "--epochs"]):
        with pytest.raises(UserError):
            as_changes(broken)
