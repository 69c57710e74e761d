"""Modules and files that pages, docstrings and comments name are there."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from sources import PACKAGES, ROOT, sources

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_TOPS = "|".join(PACKAGES)
# `synth.fem.laws`, `synth/fem/laws.py`, `tests/repo`; not `--synth.x`, nor the end of a longer path or name.
_DOTTED = re.compile(rf"(?<![\w./@-])(?:{_TOPS})(?:\.[a-zA-Z_]\w*)+")
_PATH = re.compile(rf"(?<!\]\()(?<![\w./@-])(?:{_TOPS}|tests|examples)/[\w/]+(?:\.[a-z0-9]+)*")
_COMMENT = re.compile(r"(?:^|\s)# .*")


def references(text: str) -> set[str]:
    """What a text names of ours, dotted or as a path."""
    return {*_DOTTED.findall(text), *_PATH.findall(text)}


def said(text: str) -> Iterator[str]:
    """Docstrings and comments of a source."""
    for node in ast.walk(ast.parse(text)):
        # A string that stands by itself documents what is above it.
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node.value.value
    yield from _COMMENT.findall(text)


def there(name: str) -> bool:
    """Whether a name leads to a file, a folder, or something that a module defines at its top."""
    if "/" in name:
        return (ROOT / name).exists()
    parts = name.split(".")
    for depth in range(len(parts), 0, -1):
        base = ROOT.joinpath(*parts[:depth])
        path = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
        if path.with_suffix(".pyi").is_file():  # says what a package looks up when asked
            path = path.with_suffix(".pyi")
        if path.is_file():
            return depth == len(parts) or parts[depth] in defined(path)
    return False


def defined(path: Path) -> set[str]:
    """Names that a module has at its top."""
    names: set[str] = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)}
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names |= {alias.asname or alias.name for alias in node.names}
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_a_page_names_is_there(page: Path) -> None:
    assert not [name for name in sorted(references(page.read_text("utf-8"))) if not there(name)]


def test_what_docstrings_and_comments_name_is_there() -> None:
    lost = []
    for path in sources(*PACKAGES, "tests", "examples", "docs"):
        found = references("\n".join(said(path.read_text("utf-8"))))
        lost += [f"{path.relative_to(ROOT)}: {name}" for name in sorted(found) if not there(name)]
    assert not lost, "\n".join(lost)


def test_a_name_that_leads_nowhere_is_seen() -> None:
    names = references("See `synth.fem.laws.energy_of`, `synth.skin`, synth/fem/crew.py and tests/repo.")
    assert names == {"synth.fem.laws.energy_of", "synth.skin", "synth/fem/crew.py", "tests/repo"}
    assert [name for name in sorted(names) if there(name)] == ["tests/repo"]
    assert there("synth.errors.UserError")
    assert there("synth/fem/laws.py")
    assert list(said('"""One."""\nx = "no"  # two\n')) == ["One.", " # two"]
