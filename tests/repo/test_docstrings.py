"""Everything public says what it does, and in `synth` what shape the arrays have that it takes and gives."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ARRAYS = re.compile(r"\b(NDArray|Floats|Ints|Map|Mask|Rgb|Flags|Curve|Tensor|Indices|Cells)\b")
SHAPE = re.compile(r"\((\.\.\.[,)]|[\w*+ ]{1,8},)|[Aa]s (in )?`|See `")


def public(*packages: str) -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    """Public functions and classes at the top of a file, with where they are."""
    for package in packages:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.parse(path.read_text("utf-8")).body:
                if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                    yield f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", node


def silent_on_shape(node: ast.FunctionDef) -> bool:
    """Whether a function takes or gives arrays and its docstring names no shape, nor one that does."""
    arguments = [one.annotation for one in [*node.args.args, *node.args.kwonlyargs]]
    types = " ".join(ast.unparse(one) for one in [*arguments, node.returns] if one)
    said = ast.get_docstring(node) or ""
    return bool(ARRAYS.search(types)) and not SHAPE.search(said)


def test_everything_public_has_a_docstring() -> None:
    silent = [where for where, node in public("synth", "learn", "bench") if not ast.get_docstring(node)]
    assert not silent, "\n".join(silent)


def test_shapes_are_said_in_synth() -> None:
    functions = [(where, node) for where, node in public("synth") if isinstance(node, ast.FunctionDef)]
    rooms = {path.parent.name for path in (ROOT / "synth").glob("*/__init__.py")}
    assert rooms <= {where.split("/")[1] for where, _ in functions}, "the walk leaves rooms out"
    silent = [where for where, node in functions if silent_on_shape(node)]
    assert not silent, "\n".join(silent)


def test_a_silent_function_is_seen() -> None:
    silent, telling = (
        ast.parse(f'def area(a: Floats) -> Floats:\n    """{said}"""').body[0]
        for said in ("Its area.", "Its area, (N,) mm^2.")
    )
    assert isinstance(silent, ast.FunctionDef)
    assert isinstance(telling, ast.FunctionDef)
    assert silent_on_shape(silent)
    assert not silent_on_shape(telling)
