"""Every room on one page, and measured anew by the commands that the data name."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from typer.main import get_command

from bench.cli import app
from evidence import overview
from synth.errors import UserError

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def saved(folder: Path, **found: object) -> Path:
    folder.mkdir(parents=True)
    (folder / "found.json").write_text(json.dumps(found))
    return folder / "found.json"


def test_commands_are_run_into_the_folders_of_their_data(tmp_path: Path) -> None:
    one = saved(tmp_path / "one", command="bench pareto one --only 'a b'")
    two = saved(tmp_path / "two", command="bench stability two --seed 3")
    ran: list[list[str]] = []

    def bench(words: list[str]) -> int:
        ran.append(words)
        return 0

    overview.again([one, two], bench)
    assert ran == [
        ["pareto", "one", "--only", "a b", "--out", str(one.parent)],
        ["stability", "two", "--seed", "3", "--out", str(two.parent)],
    ]


def test_nothing_is_run_if_a_file_names_no_command(tmp_path: Path) -> None:
    files = [saved(tmp_path / "one", command="bench pareto one"), saved(tmp_path / "two", rows=[])]
    with pytest.raises(UserError, match=r"two/found\.json: names no command"):
        overview.again(files, lambda words: pytest.fail("was run"))


def test_a_command_that_fails_ends_it(tmp_path: Path) -> None:
    files = [saved(tmp_path / name, command=f"bench pareto {name}") for name in ("one", "two")]
    ran = []
    with pytest.raises(UserError, match="bench pareto one: ended with 3"):
        overview.again(files, lambda words: ran.append(words) or 3)
    assert len(ran) == 1


@pytest.mark.parametrize("name", [*overview.PARETO, *overview.STABILITY])
def test_the_command_of_committed_data_can_be_typed(name: str) -> None:
    """`--run` types it with the folder of the data behind it."""
    command = json.loads((RESULTS / name).read_text("utf-8"))["command"]
    first, group, room, *words = shlex.split(command)
    assert first == "bench"
    groups = get_command(app)
    entry = groups.get_command(groups.make_context("bench", [group, room], resilient_parsing=True), group)
    single = entry.get_command(None, room)
    context = single.make_context(room, [*words, "--out", str(RESULTS / name)])
    assert context.params["out"] == RESULTS / name
