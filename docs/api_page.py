"""The reference page of the Python packages, from signatures and docstrings."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from pydantic import BaseModel

PACKAGES = {
    "synth": "Scenes and datasets.",
    "learn": "From displacement to force, by a trained network.",
    "bench": "Scores against a force sensor.",
}
_CHAIN = """
import learn
import synth

job = synth.load_job("tiny", ["seed=3"])  # or synth.Job(...)
scene = synth.simulate(job, 0)  # built and moved
frames = list(scene.frames())  # pictures and ground truth
recovered = scene.recover_flow(frames)
model = learn.load_model("model")
about = scene.tissue, scene.scale_mm_per_px, scene.young_kpa
force = learn.predict_force(model, recovered.flow, *about, recovered.confidence)  # (T, 3) mN
print(abs(force - scene.force).max())  # against the true force
""".strip()
_SECTION = re.compile(r"^(Args|Returns|Raises):$")


def write_page(note: str) -> str:
    """The page; `note` says that it is generated."""
    lines = [
        "# The Python packages",
        "",
        f"{note} Names on this page are stable; modules inside the packages may",
        "change. Importing a package loads nothing: each name is looked up when first used.",
        "",
        "Whole programs are in `examples`, with a notebook from a job to a force curve. The shortest:",
        "",
        "```python",
        _CHAIN,
        "```",
    ]
    for name, summary in PACKAGES.items():
        lines += ["", f"## {name}", "", summary]
        package = import_module(name)
        for public in sorted(package.__all__, key=lambda symbol: (symbol[0].isupper(), symbol.lower())):
            lines += _describe(f"{name}.{public}", getattr(package, public))
    return "\n".join(lines) + "\n"


def _describe(name: str, value: Any) -> Iterator[str]:
    """A function or class as Markdown."""
    yield from ("", f"### {name}", "")
    if not inspect.isclass(value):
        yield from (f"    {_format_signature(name, value)}", "", *_markdown(value.__doc__))
        return
    yield from _markdown(value.__doc__)
    if issubclass(value, BaseModel):
        yield from ("", "Its keys are those of [the job file](job.md), as keywords and nested mappings.")
        return
    if issubclass(value, BaseException):
        return
    members = list(_members(value))
    if members:
        yield from ("", "| member | what |", "| --- | --- |")
        for member, summary in members:
            text = " ".join(summary.split("\n\n")[0].split()).replace("|", r"\|")
            yield f"| `{member}` | {text} |"


def _members(value: type) -> Iterator[tuple[str, str]]:
    """Public attributes, properties and methods that have a docstring, in the order of the source."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]
    assert isinstance(tree, ast.ClassDef)
    for node, next_node in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            below = next_node.value if isinstance(next_node, ast.Expr) else None
            if not node.target.id.startswith("_") and isinstance(below, ast.Constant):
                yield node.target.id, str(below.value)
        elif isinstance(node, ast.FunctionDef) and (not node.name.startswith("_") or node.name == "__call__"):
            text = ast.get_docstring(node)
            is_property = any(
                isinstance(decorator, ast.Name) and decorator.id.endswith("property")
                for decorator in node.decorator_list
            )
            names = [argument.arg for argument in node.args.args[1:]]
            call_name = "" if node.name == "__call__" else node.name
            if text:
                yield (node.name if is_property else f"{call_name}({', '.join(names)})"), text


def _format_signature(name: str, function: Any) -> str:
    """Its signature without types."""
    parameters = [
        parameter.replace(annotation=inspect.Parameter.empty)
        for parameter in inspect.signature(function).parameters.values()
    ]
    return name + str(inspect.Signature(parameters))


def _markdown(text: str | None) -> Iterator[str]:
    """A docstring as Markdown: paragraphs, and its sections as lists."""
    inside = ""
    for line in inspect.cleandoc(text or "").splitlines():
        section = _SECTION.match(line)
        if section:
            inside = section[1]
            yield from (f"**{inside}**", "")
        elif inside and line.startswith("    ") and not line.startswith("     "):
            key, colon, rest = line.strip().partition(": ")
            yield f"- `{key}`: {rest}" if colon and inside != "Returns" else f"- {line.strip()}"
        elif inside and line.strip():
            yield f"  {line.strip()}"
        else:
            yield line
