"""No command and no option that there once was goes missing; new ones may come.

`commands.json` is of the commit before the rooms: every command with its arguments (in capitals) and options.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from generate import commands

RECORD: dict[str, list[str]] = json.loads(Path(__file__).with_name("commands.json").read_text("utf-8"))
NOW = {
    " ".join(spoken.words): [
        name
        for one in spoken.command.params
        for name in (
            [*one.opts, *one.secondary_opts] if one.param_type_name == "option" else [one.name.upper()]
        )
    ]
    for spoken in commands()
}


@pytest.mark.parametrize("words", RECORD)
def test_the_command_and_its_options_are_there(words: str) -> None:
    assert words in NOW
    assert [name for name in RECORD[words] if name not in NOW[words]] == []


def test_the_record_is_no_empty_one() -> None:
    assert len(RECORD) >= 74
    assert RECORD["bench pareto fem"] == ["--load", "--refined", "--contacts", "--out", "-o", "--json"]


@pytest.mark.parametrize("words", RECORD)
def test_arguments_stand_in_their_order(words: str) -> None:
    def placed(names: list[str]) -> list[str]:
        return [name for name in names if not name.startswith("-")]

    assert placed(NOW[words])[: len(placed(RECORD[words]))] == placed(RECORD[words])
