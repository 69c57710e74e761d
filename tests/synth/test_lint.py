"""Rules that keep a dataset a function of its job, and the rooms apart; checked on the source itself."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("synth", "learn", "bench")

# Progress, patience with processes and timings are not content; the stopwatch is the clock for the last.
MAY_READ_CLOCKS = {
    "synth/stopwatch.py",
    "synth/progress.py",
    "synth/child.py",
    "synth/cluster.py",
    "synth/journal.py",
    "synth/folder.py",
    "synth/tune_command.py",
}
CLOCKS = {"time", "datetime", "uuid", "secrets"}
RANDOM_CLASSES = {"Generator", "SeedSequence", "default_rng", "PCG64", "BitGenerator"}


def sources(*packages: str) -> list[Path]:
    found = sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))
    assert len(found) > len(packages)
    return found


def imports(path: Path) -> Iterator[str]:
    yield from imported(ast.parse(path.read_text("utf-8")))


def imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def attributes(text: str) -> Iterator[str]:
    """Dotted names used in the source: `np.random.rand`."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute):
            yield ast.unparse(node)


def global_random(text: str) -> list[str]:
    """Uses of a generator that nobody passed in."""
    bad = []
    for name in attributes(text):
        head, _, tail = name.rpartition(".")
        if head in ("np.random", "numpy.random") and tail not in RANDOM_CLASSES:
            bad.append(name)
        if head == "random" or name in ("torch.rand", "torch.randn", "torch.manual_seed"):
            bad.append(name)
    return bad


def test_no_clock_no_uuid_in_synth() -> None:
    for path in sources("synth"):
        if str(path.relative_to(ROOT)) not in MAY_READ_CLOCKS:
            used = {name.split(".")[0] for name in imports(path)} & CLOCKS
            assert not used, f"{path} imports {used}: what it makes would depend on when it runs"


def test_no_global_generator_in_synth() -> None:
    for path in sources("synth"):
        assert not global_random(path.read_text("utf-8")), path
        assert "random" not in set(imports(path)), path


def test_an_unseeded_generator_is_seen() -> None:
    assert global_random("import numpy as np\nx = np.random.rand(3)") == ["np.random.rand"]
    assert not global_random("import numpy as np\nrng: np.random.Generator = np.random.default_rng(3)")


def test_no_generator_without_a_seed_in_synth() -> None:
    for path in sources("synth"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng"):
                assert node.args, f"{path}:{node.lineno}: default_rng() takes its seed from the machine"


@pytest.mark.parametrize(
    ("room", "barred"),
    [
        ("synth", ("learn", "bench")),
        ("synth/fem", ("synth.render", "synth.flow", "synth.pipeline", "synth.store")),
        ("synth/render", ("synth.fem", "synth.flow", "synth.pipeline", "synth.store")),
        ("synth/flow", ("synth.fem", "synth.render", "synth.pipeline", "synth.store")),
        ("learn", ("bench", "mitsuba", "drjit", "synth.render", "synth.fem", "synth.pipeline")),
    ],
)
def test_rooms_do_not_reach_into_one_another(room: str, barred: tuple[str, ...]) -> None:
    for path in sources(room):
        for name in imports(path):
            crossed = [other for other in barred if name == other or name.startswith(f"{other}.")]
            assert not crossed, f"{path} imports {name}"


def reached(*rooms: str) -> set[str]:
    """Names of all modules that importing a room's modules imports, one through another."""
    modules = {}
    for path in sources(*PACKAGES):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        tree = ast.parse(path.read_text("utf-8"))
        tree.body = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        modules[name] = set(imported(tree))
    found: set[str] = set()
    todo = [name for name in modules if name.split(".")[0] in rooms]
    while todo:
        for name in modules.get(todo.pop(), set()) - found:
            found.add(name)
            todo.append(name)
    return found


def test_learn_loads_no_renderer_by_way_of_another_module() -> None:
    found = reached("learn")
    assert {"torch", "synth.store", "synth.job"} <= found
    assert not [name for name in found if name.startswith(("mitsuba", "drjit", "bench", "synth.render"))]
    assert "synth.pipeline" in reached("bench") | reached("synth"), "the walk sees nothing"


def test_only_the_adapter_imports_mitsuba_at_the_top() -> None:
    """Mitsuba is loaded after its variant and LLVM are chosen, never on the way of another import."""
    for path in sources("synth", "learn", "bench"):
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.Import) and any(alias.name == "mitsuba" for alias in node.names):
                assert path.parent.name == "render", path


def test_no_path_of_a_machine_anywhere() -> None:
    for path in [
        *sources(*PACKAGES, "tests", "examples", "docs"),
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
    ]:
        text = path.read_text("utf-8")
        for marker in ("/home" + "/", "/root" + "/", "/work" + "/", "/Users" + "/"):
            assert marker not in text, f"{path} names {marker}"


def test_files_stay_short() -> None:
    for path in sources(*PACKAGES):
        lines = len(path.read_text("utf-8").splitlines())
        assert lines <= 400, f"{path} has {lines} lines: look for the second noun"
