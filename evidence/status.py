"""What made every stored result, whether that has changed since, and what making it again costs."""

import ast
import hashlib
import json
import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

from evidence.report import CHECKOUT

_OURS = re.compile(r"(synth|learn|bench|evidence)(\.\w+)+")
_SCORED = re.compile(r"^\s*bench score", re.M)


@dataclass(frozen=True)
class Status:
    """One stored result."""

    file: str
    command: str
    commit: str
    changed: tuple[str, ...] | None
    """Files imported by its study, and data of the checkout that it read, that differ from those that made
    it; None where study or commit are unknown."""
    cpu_hours: float | None

    def row(self) -> dict[str, Any]:
        """Cells of a table."""
        state = "unknown" if self.changed is None else "current"
        if self.changed:
            state = f"stale: {len(self.changed)} files"
        made = {"commit": self.commit, "CPU-hours": self.cpu_hours, "command": self.command.split("\n")[0]}
        return {"result": self.file, "state": state, **made}


def gather(results: Path, modules: Mapping[str, str], home: Path = CHECKOUT) -> list[Status]:
    """Status of every JSON file of a folder in the checkout `home`, sorted by name.

    `modules`: the study that makes the files of a pattern, relative to the folder.
    """

    def module(name: str) -> str:
        return next((one for pattern, one in modules.items() if fnmatch(name, pattern)), "")

    files = sorted(results.rglob("*.json"))
    return [_status(file, module(str(file.relative_to(results))), home) for file in files]


def closure(module: str, home: Path = CHECKOUT) -> set[Path]:
    """Files of a module and of all modules of this project that it imports, directly or indirectly.

    Module names in strings count too: they are imported by other processes. Flow estimators are found by
    name, so that a module which imports one of them depends on all.
    """
    found: set[Path] = set()
    waiting = [module]
    while waiting:
        file = _file(waiting.pop(), home)
        if file is None or file in found:
            continue
        found.add(file)
        waiting += _imported(file, file.stat().st_mtime_ns)
        if file.parent == home / "synth/flow":
            waiting += [f"synth.flow.{other.stem}" for other in file.parent.glob("*.py")]
    return found


def content(path: Path) -> str:
    """Hash of a file's content, or of all JSON and YAML files of a folder, which include hashes of arrays."""
    total = hashlib.blake2b(digest_size=8)
    files = [path] if path.is_file() else [p for kind in ("json", "yaml") for p in path.rglob(f"*.{kind}")]
    for file in sorted(files):
        total.update(f"{file.relative_to(path)}\n".encode() + file.read_bytes())
    return total.hexdigest()


def data(*paths: Path, home: Path = CHECKOUT) -> dict[str, str]:
    """Content hashes by path in the checkout, or by name for data elsewhere; results store them."""
    return {
        str(path.relative_to(home)) if path.is_relative_to(home) else path.name: content(path)
        for path in map(Path.resolve, paths)
    }


def _status(file: Path, module: str, home: Path) -> Status:
    found = json.loads(file.read_text("utf-8"))
    found = found if isinstance(found, dict) else {}
    name, command = str(file.relative_to(home)), str(found.get("command", ""))
    commit = str(found.get("commit") or _git(home, "log", "-1", "--format=%h", "--", name)).strip()
    changed = None
    base = commit.rstrip("+")
    if module and _git(home, "cat-file", "-t", base):
        files = closure(module, home) | (closure("bench.cli", home) if _SCORED.search(command) else set())
        ours = {str(one.relative_to(home)) for one in files}
        read = {path: word for path, word in found.get("data", {}).items() if (home / path).exists()}
        other = {path for path, word in read.items() if content(home / path) != word}
        new = _git(home, "ls-files", "--others", "--exclude-standard")
        differing = {*_git(home, "diff", "--name-only", base).splitlines(), *new.splitlines()}
        changed = tuple(sorted(ours & differing | other))
    return Status(name, command, commit, changed, found.get("cpu_hours"))


@cache
def _imported(file: Path, _changed_ns: int) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Constant) and (known := _OURS.match(str(node.value))):
            names.append(known[0])
    return names


def _file(module: str, home: Path) -> Path | None:
    at = home.joinpath(*module.split("."))
    return next((one for one in (at.with_suffix(".py"), at / "__init__.py") if one.is_file()), None)


def _git(home: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", str(home), *words], capture_output=True, text=True).stdout
