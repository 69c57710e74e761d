"""Every command says what it does, every parameter what it means, and its examples can be typed."""

from __future__ import annotations

import re
import shlex

import pytest
from generate import Spoken, commands

import bench.cli
import learn.cli
import synth.cli
from evidence.commands import COMMANDS

SPOKEN = list(commands())
DOING = [spoken for spoken in SPOKEN if not hasattr(spoken.command, "list_commands")]


def _name(spoken: Spoken) -> str:
    return "-".join(spoken.words)


def _arguments(line: str, words: tuple[str, ...]) -> list[str]:
    """What follows the command in a typed line, up to the shell's own signs."""
    typed = shlex.split(line)
    assert tuple(typed[: len(words)]) == words, f"{line}: is an example of another command"
    end = next((k for k, word in enumerate(typed) if word in (">", "|")), len(typed))
    return typed[len(words) : end]


def test_the_walk_reaches_every_program_and_group() -> None:
    words = {spoken.words for spoken in DOING}
    assert {("synth", "render"), ("learn", "train"), ("bench", "score")} <= words
    assert {("bench", *said.split()) for said in COMMANDS} <= words
    for program, app in {"bench": bench.cli.app, "learn": learn.cli.app, "synth": synth.cli.app}.items():
        for command in app.registered_commands:
            name = command.name or command.callback.__name__.strip("_").replace("_", "-")
            assert (program, name) in words


@pytest.mark.parametrize("spoken", SPOKEN, ids=_name)
def test_it_says_what_it_does_and_what_its_parameters_mean(spoken: Spoken) -> None:
    assert spoken.command.help, "has no description"
    silent = [
        one.name for one in spoken.command.params if one.name != "help" and not (one.help or "").strip()
    ]
    assert not silent, f"parameters without help: {silent}"


@pytest.mark.parametrize("spoken", SPOKEN, ids=_name)
def test_units_in_brackets_reach_the_reader(spoken: Spoken, capsys: pytest.CaptureFixture[str]) -> None:
    """Rich reads `[kPa]` as markup, and shows nothing."""
    context = spoken.command.make_context(spoken.words[-1], [], resilient_parsing=True)
    print(spoken.command.get_help(context))
    seen = capsys.readouterr().out
    texts = [spoken.command.help or "", *(getattr(one, "help", None) or "" for one in spoken.command.params)]
    for unit in re.findall(r"\[[^\]]+\]", " ".join(texts)):
        assert "".join(unit.split()) in "".join(seen.split()), unit


def test_there_are_units_in_brackets() -> None:
    young = next(one for spoken in DOING for one in spoken.command.params if one.name == "young")
    assert "[kPa]" in young.help


@pytest.mark.parametrize("spoken", DOING, ids=_name)
def test_its_examples_can_be_typed(spoken: Spoken) -> None:
    assert spoken.examples, (
        'has no example: epilog="Example: ..." of the command, or `example` in evidence.commands'
    )
    for line in spoken.examples:
        spoken.command.make_context(spoken.words[-1], _arguments(line, spoken.words))


def test_an_option_that_does_not_exist_is_seen() -> None:
    render = next(spoken for spoken in SPOKEN if spoken.words == ("synth", "render"))
    with pytest.raises(Exception, match="No such option"):
        render.command.make_context("render", _arguments("synth render demo --colour red", render.words))
