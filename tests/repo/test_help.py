"""Every command says what it does, every parameter what it means, and its examples can be typed."""

from __future__ import annotations

import shlex

import pytest
from generate import Spoken, commands

SPOKEN = list(commands())


@pytest.mark.parametrize("spoken", SPOKEN, ids=lambda spoken: "-".join(spoken.words))
def test_help_and_examples(spoken: Spoken) -> None:
    assert spoken.command.help
    silent = [one.name for one in spoken.command.params if one.name != "help" and not one.help]
    assert not silent, f"parameters without help: {silent}"
    assert spoken.examples or spoken.group, 'has no example: epilog="Example: ..." of the command'
    for line in spoken.examples:
        typed = shlex.split(line)
        assert tuple(typed[: len(spoken.words)]) == spoken.words
        end = next((k for k, word in enumerate(typed) if word in (">", "|")), len(typed))
        if not spoken.group:
            spoken.command.make_context(spoken.words[-1], typed[len(spoken.words) : end])
