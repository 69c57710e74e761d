"""Rooms know only those below them; checked on the source itself."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

from sources import PACKAGES, ROOT, imported, imports, module, parsed, sources

# From the ground up: a room, or a file that stands by itself, may import what comes before it.
ORDER = (
    "synth",
    "synth.errors",
    "synth.fields",
    "synth.formats",
    "synth.plugins",
    "synth.system",
    "synth.job",
    "synth.flow",
    "synth.flow.stereo",
    "synth.video",
    "synth.recording_flow",
    "synth.geometry",
    "synth.fem.mesh",
    "synth.fem",
    "synth.render.camera",
    "synth.render.mitsuba",
    "synth.render.appearance",
    "synth.render.anatomy",
    "synth.render",
    "synth.dataset",
    "synth.sequence",
    "synth.checks",
    "synth.publish",
    "synth.publish.export",
    "synth.engine",
    "synth.tune",
    "synth.fit",
    "synth.cli",
    "synth.__main__",
    "learn",
    "learn.data",
    "learn.uncertainty",
    "learn.network",
    "learn.loss",
    "learn.settings",
    "learn.checkpoint",
    "learn.split",
    "learn.inference",
    "learn.evaluation",
    "learn.training",
    "learn.cli",
    "learn.__main__",
    "bench",
    "bench.bootstrap",
    "bench.recording",
    "bench.importers",
    "bench.sensor",
    "bench.methods",
    "bench.tracking",
    "bench.scoring",
    "bench.cli",
    "bench.__main__",
    "evidence",
)

# Meeting only in `synth.sequence`: physics, pictures and flow know nothing of each other.
APART = ("synth.fem", "synth.render", "synth.flow")


def room(name: str) -> str:
    """The entry of `ORDER` that a module belongs to: the longest that it lies in."""
    return max((one for one in ORDER if name == one or name.startswith(f"{one}.")), key=len)


@cache
def modules() -> set[str]:
    """All modules of ours."""
    return {module(source) for source in sources(*PACKAGES)}


def ours(path: Path) -> set[str]:
    """Modules of ours that a file imports, anywhere in it."""
    return modules().intersection(imports(path))


def test_imports_go_down_only() -> None:
    place = {name: k for k, name in enumerate(ORDER)}
    up = []
    for path in sources(*PACKAGES):
        mine = room(module(path))
        for name in ours(path):
            other = room(name)
            if place[other] > place[mine] and not name.startswith(f"{module(path)}."):
                up.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not up, "\n".join(up)


def test_every_room_is_in_the_order() -> None:
    rooms = {module(path.parent / "__init__.py") for path in sources("synth", "learn", "bench")}
    assert rooms <= set(ORDER), sorted(rooms - set(ORDER))
    files = {
        module(path) for package in ("synth", "learn", "bench") for path in (ROOT / package).glob("*.py")
    }
    assert files <= set(ORDER), sorted(files - set(ORDER))


def test_physics_pictures_and_flow_do_not_know_each_other() -> None:
    for one in APART:
        for path in sources(one.replace(".", "/")):
            met = [name for name in ours(path) for other in APART if other != one and name.startswith(other)]
            assert not met, f"{path} imports {met}"


def test_the_product_knows_nothing_of_the_evidence() -> None:
    for path in sources("synth", "learn", "bench", "examples"):
        assert not [name for name in imports(path) if name.split(".")[0] == "evidence"], path
    assert [name for path in sources("evidence") for name in imports(path) if name.startswith("bench.")]


def test_a_room_is_neither_a_drawer_nor_a_hall() -> None:
    for folder in {path.parent for path in sources(*PACKAGES)}:
        files = [path for path in folder.glob("*.py") if path.name not in ("__init__.py", "__main__.py")]
        assert len(files) <= 16, f"{folder} has {len(files)} files: look for the second room"
        said = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8")))
        assert said, f"{folder} doesn't say what it is for"
        assert "\n" not in said, f"{folder} needs more than a line to say what it is for"


def reached(*rooms: str) -> set[str]:
    """Names of all modules that importing a room's modules imports, one through another."""
    loaded = {}
    for path in sources(*PACKAGES):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        top = [node for node in parsed(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
        loaded[name] = set(imported(ast.Module(top, [])))
    found: set[str] = set()
    todo = [name for name in loaded if name.split(".")[0] in rooms]
    while todo:
        for name in loaded.get(todo.pop(), set()) - found:
            found.add(name)
            todo.append(name)
    return found


def test_learn_loads_no_renderer_by_way_of_another_module() -> None:
    found = reached("learn")
    assert {"torch", "synth.dataset.store", "synth.job.schema"} <= found
    assert not [name for name in found if name.startswith(("mitsuba", "drjit", "bench", "synth.render"))]
    assert "synth.sequence.pipeline" in reached("bench") | reached("synth"), "the walk sees nothing"


def test_only_the_adapter_imports_mitsuba_at_the_top() -> None:
    """Mitsuba is loaded after its variant and LLVM are chosen, never on the way of another import."""
    for path in sources(*PACKAGES):
        for node in parsed(path).body:
            if isinstance(node, ast.Import) and any(alias.name == "mitsuba" for alias in node.names):
                assert path.parent.name == "mitsuba", path
