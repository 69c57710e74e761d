"""The pages say what the code says: tables are written by it, blocks run, commands and keys exist."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import generate
import pytest
from ruamel.yaml import YAML

from bench.recording.meta import Meta
from synth.job.schema import Job

DOCS = generate.DOCS
ROOT = DOCS.parent
PAGES = [
    page
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
    if page.relative_to(ROOT).parts[:2] not in (("docs", "results"), ("docs", "reference"))
]
SPOKEN = {spoken.words: spoken for spoken in generate.commands()}


def blocks(page: Path, language: str) -> Iterator[tuple[str, str]]:
    """Fenced blocks of a language: title and text."""
    for found in re.finditer(rf"^```{language}(.*?)\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
        title = re.search(r'title="(.*?)"', found[1])
        yield title[1] if title else "", found[2]


def typed(page: Path) -> Iterator[str]:
    """Command lines in indented blocks, continued lines joined and comments cut."""
    for line in re.sub(r" *\\\n +", " ", page.read_text("utf-8")).splitlines():
        if re.match(r"(    )+(\.venv/bin/)?(synth|learn|bench) ", line):
            yield line.strip().removeprefix(".venv/bin/")


@pytest.mark.parametrize("page", generate.pages(), ids=lambda page: page.stem)
def test_generated_pages_are_those_of_this_code(page: Path) -> None:
    assert page.read_text("utf-8") == generate.pages()[page], "out of date: run `make docs`"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_on_the_pages_can_be_typed(page: Path) -> None:
    for line in typed(page):
        words = shlex.split(line, comments=True)
        depth = next((k for k in (3, 2) if len(words) >= k and tuple(words[:k]) in SPOKEN), 0)
        assert depth, f"{line}: there is no such command"
        spoken = SPOKEN[tuple(words[:depth])]
        if "--help" not in words and not spoken.group:
            spoken.command.make_context(words[depth - 1], words[depth:])


def test_the_pages_hold_commands() -> None:
    assert len(list(typed(ROOT / "README.md"))) >= 6
    assert sum(len(list(typed(page))) for page in PAGES) >= 30


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_jobs_and_descriptions_on_the_pages_are_valid(page: Path) -> None:
    for title, text in blocks(page, "yaml"):
        content = YAML(typ="safe").load(text)
        if title == "job.yaml":
            Job.model_validate(content)
        elif title == "meta.yaml":
            Meta.model_validate(content)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_is_said_to_be_of_an_example_is(page: Path) -> None:
    for title, text in blocks(page, "python"):
        if title.startswith("examples/"):
            assert text.strip() in (ROOT / title).read_text("utf-8"), f"{page.name} and {title} differ"


@pytest.mark.parametrize("name", ["README.md", "docs/tutorial.md"])
def test_python_on_the_pages_runs(
    name: str, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(out.parent)
    found = [text for title, text in blocks(ROOT / name, "python") if not title]
    assert found
    for text in found:
        exec(compile(text, name, "exec"), {})
    assert capsys.readouterr().out.startswith("0.81"), "the stiffness that is printed first"


def test_the_pages_build_and_load_nothing_from_elsewhere(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    science = (tmp_path / "site" / "science.html").read_text("utf-8")
    assert science.count("<math") >= 20
    assert not re.search(r"<math[^§]*?\\", science.split("</main>")[0]), "LaTeX that was not understood"
    for page in (tmp_path / "site").rglob("*.html"):
        if "results" not in page.parts:
            fetched = re.findall(r"<(?:script|link|img)[^>]*?(?:src|href)=\"(?:https?:)?//", page.read_text())
            assert not fetched, f"{page.name} loads from elsewhere"
