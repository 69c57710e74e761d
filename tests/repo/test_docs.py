"""The pages say what the code says: tables are written by it, blocks run, commands and keys exist."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

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
GENERATED = generate.pages()
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


@pytest.mark.parametrize("page", GENERATED, ids=lambda page: page.stem)
def test_generated_pages_are_those_of_this_code(page: Path) -> None:
    assert page.read_text("utf-8") == GENERATED[page], "out of date: run `make docs`"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_on_the_pages_can_be_typed(page: Path) -> None:
    for line in typed(page):
        words = shlex.split(line, comments=True)
        depth = next((k for k in (3, 2) if len(words) >= k and tuple(words[:k]) in SPOKEN), 0)
        assert depth, f"{line}: there is no such command"
        spoken = SPOKEN[tuple(words[:depth])]
        if "--help" not in words and not spoken.group:
            spoken.command.make_context(words[depth - 1], words[depth:])


def test_commands_of_a_page_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    lines = [
        "Say synth render.",
        "    .venv/bin/synth verify out \\",
        "        --json",
        "1. So:",
        "        bench flow a",
    ]
    page.write_text("\n".join(lines))
    assert list(typed(page)) == ["synth verify out --json", "bench flow a"]
    whole_way = {tuple(line.split()[:2]) for line in typed(ROOT / "README.md")}
    assert whole_way >= {("synth", "render"), ("synth", "verify"), ("learn", "train"), ("bench", "score")}


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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["README.md", "docs/tutorial.md"])
def test_python_on_the_pages_runs(
    name: str, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(out.parent)
    found = [text for title, text in blocks(ROOT / name, "python") if not title]
    assert found
    for text in found:
        exec(compile(text, name, "exec"), {})
    said = capsys.readouterr().out.splitlines()
    assert any(line.startswith("0.81") for line in said), "the stiffness of the dataset's first sequence"


def build(folder: Path) -> subprocess.CompletedProcess[str]:
    """Builds the site in a folder that holds mkdocs.yml and docs, as `make docs` does."""
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    environment = {**os.environ, "PYTHONPATH": "docs"}
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; from a copy, as a build writes beside its pages."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(DOCS, folder / "docs")
    shutil.copy(ROOT / "mkdocs.yml", folder)
    done = build(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "site"


class _Links(HTMLParser):
    """What a page fetches, what it links to, and the places in it that can be linked to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.linked: list[str] = []
        self.places: set[str] = set()
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.places.add(value or "")
            elif name in ("src", "href") and value:
                (self.linked if tag == "a" else self.fetched).append(value)


@pytest.mark.slow
def test_equations_need_no_script(site: Path) -> None:
    science = (site / "science.html").read_text("utf-8")
    fences = len(list(blocks(DOCS / "science.md", "math")))
    assert science.count("<math") == fences >= 20
    assert not re.search(r"<math[^§]*?\\", science.split("</main>")[0]), "LaTeX that was not understood"


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        away = [one for one in _Links(page).fetched if re.match(r"(https?:)?//", one)]
        assert not away, f"{page.relative_to(site)} loads {away}"


def test_pages_open_from_disk_and_every_link_leads_somewhere(site: Path) -> None:
    """More than `--strict` asks, which passes over pictures, data files and the list of pages."""
    pages = {page: _Links(page) for page in site.rglob("*.html") if page.name != "404.html"}
    broken = []
    for page, links in pages.items():
        for link in {*links.fetched, *links.linked}:
            path, _, place = link.partition("#")
            if re.match(r"[a-z]+:", link):
                continue
            target = (page.parent / unquote(path)).resolve() if path else page
            found = target.is_file() and (target not in pages or not place or place in pages[target].places)
            if not found:
                broken.append(f"{page.relative_to(site)}: {link}")
    assert not broken, "\n".join(broken)


@pytest.mark.slow
def test_a_broken_link_stops_the_build(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    shutil.copy(DOCS / "equations.py", tmp_path / "docs")
    head = (ROOT / "mkdocs.yml").read_text("utf-8").partition("nav:")[0]
    (tmp_path / "mkdocs.yml").write_text(head)
    page = tmp_path / "docs" / "index.md"
    page.write_text("# One {#one}\n\nSee [itself](index.md#one).\n")
    assert build(tmp_path).returncode == 0
    for link in ("nowhere.md", "index.md#two"):
        page.write_text(f"# One {{#one}}\n\nSee [itself]({link}).\n")
        done = build(tmp_path)
        assert done.returncode != 0
        assert "does not exist" in done.stdout + done.stderr
