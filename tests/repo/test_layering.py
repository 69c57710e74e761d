"""Packages import only from those below them; checked on the source itself."""

import ast
from functools import cache
from pathlib import Path

from sources import PACKAGES, ROOT, imports, list_imports, module, parse, sources

INSIDE = {
    "synth": "arrays errors arguments fields formats plugins system fem.law_choice job flow flow.stereo "
    "video flow.recording geometry fem.mesh fem fem.external "
    "render.camera render.materials render.mitsuba render.appearance render.anatomy render.randomized render "
    "dataset sequence checks publish publish.export engine tune fit cli __main__",
    "learn": "data uncertainty network loss settings checkpoint split inference evaluation training "
    "cli __main__",
    "bench": "bootstrap recording importers sensor methods tracking checks scoring cli __main__",
    "evidence": "",
    "weights": "",
}
ORDER = [
    name for top, names in INSIDE.items() for name in (top, *(f"{top}.{part}" for part in names.split()))
]
"""Packages, and files outside of any, from the ground up: each may import from those before it."""

APART = ("synth.fem", "synth.render", "synth.flow")
"""Physics, rendering and flow: combined in `synth.sequence` only."""


def package(name: str) -> str:
    """The entry of `ORDER` that a module belongs to: the longest match."""
    return max((entry for entry in ORDER if name == entry or name.startswith(f"{entry}.")), key=len)


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
        importer = package(module(path))
        for name in ours(path):
            imported_package = package(name)
            if place[imported_package] > place[importer] and not name.startswith(f"{module(path)}."):
                up.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not up, "\n".join(up)


def test_every_package_is_in_the_order() -> None:
    product = ("synth", "learn", "bench")
    packages = {module(path.parent / "__init__.py") for path in sources(*product)}
    packages |= {module(path) for name in product for path in (ROOT / name).glob("*.py")}
    assert packages <= set(ORDER), sorted(packages - set(ORDER))


def test_physics_rendering_and_flow_do_not_import_each_other() -> None:
    for package_name in APART:
        for path in sources(package_name.replace(".", "/")):
            crossings = [
                name
                for name in ours(path)
                for other in APART
                if other != package_name and name.startswith(other)
            ]
            assert not crossings, f"{path} imports {crossings}"


def test_numerics_never_see_a_job() -> None:
    for path in sources("synth/fem", "synth/render", "synth/flow", "synth/geometry"):
        assert not [name for name in ours(path) if name.startswith("synth.job")], path


def test_the_product_does_not_import_evidence() -> None:
    for path in sources("synth", "learn", "bench", "examples"):
        assert not [name for name in imports(path) if name.split(".")[0] in ("evidence", "weights")], path
    assert [name for path in sources("evidence") for name in imports(path) if name.startswith("bench.")]


def test_every_package_has_a_line_that_describes_it() -> None:
    for folder in {path.parent for path in sources(*PACKAGES)}:
        docstring = ast.get_docstring(parse(folder / "__init__.py"))
        assert docstring, f"{folder} has no docstring"
        assert "\n" not in docstring, f"{folder}: its docstring has more than one line"


def collect_imports(*packages: str) -> set[str]:
    """Names of all modules that importing these packages' modules imports, directly or through others."""
    imports_of = {}
    for path in sources(*PACKAGES):
        top = [node for node in parse(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
        imports_of[module(path)] = set(list_imports(ast.Module(top, [])))
    reached: set[str] = set()
    todo = [name for name in imports_of if name.split(".")[0] in packages]
    while todo:
        for name in imports_of.get(todo.pop(), set()) - reached:
            reached.add(name)
            todo.append(name)
    return reached


def test_learn_loads_no_renderer_through_another_module() -> None:
    reached = collect_imports("learn")
    assert {"torch", "synth.dataset.store", "synth.job.schema"} <= reached
    assert not [name for name in reached if name.startswith(("mitsuba", "drjit", "bench", "synth.render"))]
    assert "synth.sequence.simulation" in collect_imports("bench") | collect_imports("synth"), (
        "the walk finds no modules"
    )
