"""What made a sequence: one name for all the code and packages that shape its values."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import itertools
import json
import sys
from collections.abc import Collection, Iterable
from functools import cache
from pathlib import Path

from synth.system import packages
from synth.system.cache import folder
from synth.system.whole_file import write_whole

# Where the making of a sequence begins, and what it uses that decides no value.
_MAKER = "synth.sequence.pipeline"
_NO_PART = {
    f"synth.{name}"
    for name in (
        "errors",
        "fields",
        "job.identity",
        "system.stopwatch",
        "dataset.store",
        "dataset.provenance",
    )
}
_COMPUTING = (
    "mitsuba",
    "drjit",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "torch",
    "numba",
    "llvmlite",
)


@cache
def generator() -> dict[str, str]:
    """`{"format", "code", package: version}`: two sequences of a job are comparable when it is equal.

    `code` is a hash of the program's own statements that make a sequence; comments, docstrings and layout
    do not count.
    """
    from synth.fields import FORMAT_VERSION

    home = Path(__file__).parents[2]
    return {"format": str(FORMAT_VERSION), "code": _kept(home, _makers(home), {"synth"}), **_computing()}


def source(modules: Iterable[str], ours: Collection[str], home: Path = Path(__file__).parents[2]) -> str:
    """One word for the statements of modules and of all that they import, and for the packages that compute.

    `ours`: packages under `home` that are followed into.
    """
    return word({"code": _kept(home, modules, ours), **_computing()})


def fingerprint() -> str:
    """`generator()` in one word."""
    return word(generator())


def word(made_by: dict[str, str]) -> str:
    """What `generator()` gave, here or elsewhere, in one word."""
    described = json.dumps(made_by, sort_keys=True).encode()
    return hashlib.blake2b(described, digest_size=8).hexdigest()


def _kept(home: Path, modules: Iterable[str], ours: Collection[str]) -> str:
    """`_code` of all that modules import, kept by the files' bytes: parsing takes a second."""
    modules = sorted(modules)
    held = hashlib.blake2b("\n".join([sys.version, *modules, "", *sorted(ours)]).encode(), digest_size=16)
    for package, kind in itertools.product(sorted(ours), ("*.py", "*.pt")):
        for path in sorted((home / package).rglob(kind)):
            held.update(f"{path.relative_to(home)}\n{path.stat().st_size}\n".encode() + path.read_bytes())
    try:
        kept = folder("fingerprints") / held.hexdigest()
        if kept.is_file():
            return kept.read_text("ascii")
    except OSError:
        return _code(home, _imports(home, modules, ours))
    found = _code(home, _imports(home, modules, ours))
    with contextlib.suppress(OSError):
        write_whole(kept, found, durable=False)
    return found


def _code(home: Path, files: Iterable[Path]) -> str:
    total = hashlib.blake2b(digest_size=8)
    for path in sorted(files):
        total.update(f"{path.relative_to(home)}\n".encode())
        total.update(_statements(path).encode() if path.suffix == ".py" else path.read_bytes())
    return total.hexdigest()


def _computing() -> dict[str, str]:
    """Versions of the packages that compute."""
    return {name: found for name, found in packages.versions().items() if name in _COMPUTING}


def _makers(home: Path) -> list[str]:
    """Modules that make a sequence, with all that they import."""
    return [_MAKER, *estimators(home)]


def estimators(home: Path = Path(__file__).parents[2]) -> list[str]:
    """Modules of flow estimators: found by name, so nothing that uses them imports them."""
    return [f"synth.flow.{path.stem}" for path in (home / "synth/flow").glob("[a-z]*.py")]


def _imports(home: Path, modules: Iterable[str], ours: Collection[str]) -> set[Path]:
    """Files of modules, of all that they import of the packages `ours`, and the networks beside them.

    Packages are followed like modules, so that what an `__init__.py` re-exports counts.

    Raises:
        LookupError: an import that leads to no file of ours, or to a name that its file doesn't hold.
    """
    for name in _NO_PART:
        _file(home, name)
    found: set[Path] = set()
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        file = _file(home, name)
        if name in _NO_PART or file in found:
            continue
        found |= {file, *file.parent.glob("*.pt")}
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                waiting += [alias.name for alias in node.names if alias.name.split(".")[0] in ours]
            elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ours:
                waiting += _imported(home, str(node.module), [alias.name for alias in node.names])
            elif isinstance(node, ast.ImportFrom) and node.level:
                raise LookupError(f"{file}: relative imports can't be followed")
    return found


def _file(home: Path, name: str) -> Path:
    """The file of a module or of a package. LookupError if there is none."""
    at = home.joinpath(*name.split("."))
    for file in (at.with_suffix(".py"), at / "__init__.py"):
        if file.is_file():
            return file
    raise LookupError(f"{name}: there is no such module below {home}, so what it does can't be counted")


def _imported(home: Path, module: str, names: list[str]) -> list[str]:
    """The modules that `from module import names` runs, packages above them included."""
    parts = module.split(".")
    ran = [".".join(parts[: k + 1]) for k in range(len(parts))]
    file = _file(home, module)
    for name in names:
        below = file.parent / name
        if file.name == "__init__.py" and (below.with_suffix(".py").is_file() or below.is_dir()):
            ran.append(f"{module}.{name}")
        elif name not in _bound(ast.parse(file.read_text("utf-8")).body):
            raise LookupError(f"{file}: doesn't say what {name!r} is, so what it does can't be counted")
    return ran


def _bound(body: list[ast.stmt]) -> set[str]:
    """Names that the statements at the top of a file bind, inside `if` and `try` too."""
    names: set[str] = set()
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.If | ast.Try):
            handlers = [one for handler in getattr(node, "handlers", []) for one in handler.body]
            names |= _bound([*node.body, *node.orelse, *handlers])
        else:
            names |= {
                one.id
                for one in ast.walk(node)
                if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)
            }
    return names


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
