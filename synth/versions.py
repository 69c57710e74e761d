"""Versions of what took part in making a sequence, and one name for all that shapes its values."""

from __future__ import annotations

import ast
import hashlib
import json
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

_PACKAGES = (
    "sulcus",
    "mitsuba",
    "drjit",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "torch",
    "zarr",
)


# Where the making of a sequence begins, and what it uses that decides no value.
_MAKER = "synth.pipeline"
_NO_PART = {f"synth.{name}" for name in ("errors", "fields", "identity", "stopwatch", "store", "versions")}
_COMPUTING = ("mitsuba", "drjit", "numpy", "scipy", "opencv-contrib-python-headless", "torch")


@cache
def generator() -> dict[str, str]:
    """`{"format", "code", package: version}`: two sequences of a job are comparable when it is equal.

    `code` is a hash of the program's own statements that make a sequence; comments, docstrings and layout
    do not count.
    """
    from synth.fields import FORMAT_VERSION

    home, total = Path(__file__).parents[1], hashlib.blake2b(digest_size=8)
    for path in sorted(_makers(home)):
        total.update(f"{path.relative_to(home)}\n".encode())
        total.update(_statements(path).encode() if path.suffix == ".py" else path.read_bytes())
    packages = {name: found for name, found in of_everything().items() if name in _COMPUTING}
    return {"format": str(FORMAT_VERSION), "code": total.hexdigest(), **packages}


def fingerprint() -> str:
    """`generator()` in one word."""
    return word(generator())


def word(made_by: dict[str, str]) -> str:
    """What `generator()` gave, here or elsewhere, in one word."""
    described = json.dumps(made_by, sort_keys=True).encode()
    return hashlib.blake2b(described, digest_size=8).hexdigest()


def _makers(home: Path) -> set[Path]:
    """Files that the maker of sequences is made of: its modules, theirs, and the networks beside them."""
    found: set[Path] = set()
    # Estimators of flow are found by name, so all of them count.
    waiting = [_MAKER, *(f"synth.flow.{path.stem}" for path in (home / "synth/flow").glob("*.py"))]
    while waiting:
        name = waiting.pop()
        file = home / Path(*name.split(".")).with_suffix(".py")
        if name in _NO_PART or not file.is_file() or file in found:
            continue
        found |= {file, *file.parent.glob("*.pt")}
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                waiting += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                waiting += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return found


def _statements(path: Path) -> str:
    tree = ast.parse(path.read_text("utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            # Docstrings, under fields too.
            node.body = [one for one in body if not _is_text(one)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def _is_text(node: ast.AST) -> bool:
    held = node.value if isinstance(node, ast.Expr) else None
    return isinstance(held, ast.Constant) and isinstance(held.value, str)


def of_everything() -> dict[str, str]:
    """`{package: version}` of the installed packages that shape a sequence, and of Python."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # optional here, or run from a checkout that is not installed
    return found
