"""The project's own source, as tests of the repository read it."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("synth", "learn", "bench", "evidence", "weights")


def sources(*packages: str) -> list[Path]:
    paths = sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))
    assert len(paths) > len(packages)
    return paths


@cache
def parse(path: Path) -> ast.Module:
    """A file's syntax tree; to be read, not changed."""
    return ast.parse(path.read_text("utf-8"))


@cache
def imports(path: Path) -> tuple[str, ...]:
    return tuple(list_imports(parse(path)))


def list_imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def module(path: Path) -> str:
    """Its dotted name; of a package, the package's."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
