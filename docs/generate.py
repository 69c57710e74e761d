"""Writes the generated pages: `python docs/generate.py`, which `make docs` runs.

Job keys and meta.yaml come from their schemas, fields from the field table, commands from their own help, the
Python reference and the table of packages from docstrings, the site's list of results from its folders. A
test fails when a page differs from what is generated.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import api_page
import typer
from pydantic import BaseModel

from bench.checks import protocol
from bench.recording.meta import Meta
from synth.dataset.size_forecast import amount, field_bytes
from synth.fields import FIELDS, STORED_WHEN, TIME
from synth.job import job_writer
from synth.job.schema import Job
from synth.system.config_file import section_of

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PROGRAMS = ("synth", "learn", "bench")
PACKAGES = (*PROGRAMS, "evidence", "weights")
_WRITTEN = "Written by `make docs`; do not edit."
# The text between the two markers in CONTRIBUTING.md, and after the third in mkdocs.yml, is generated.
_TABLE = ("<!-- packages: written by `make docs` -->", "<!-- end of packages -->")
_LISTED = "  # From here on written by `make docs`"


@dataclass(frozen=True)
class Command:
    """One command of the command line."""

    words: tuple[str, ...]  # as typed: ("synth", "render")
    click: Any  # the click command; `Any`, as newer typer releases bring their own copy of click

    @property
    def group(self) -> bool:
        """Whether it only holds other commands."""
        return hasattr(self.click, "list_commands")

    @property
    def examples(self) -> list[str]:
        """The command lines of its help, each after `Example:`."""
        lines = (self.click.epilog or "").splitlines()
        return [line.partition("Example:")[2].strip() for line in lines if "Example:" in line]


def commands() -> Iterator[Command]:
    """Every command of the three programs, each group before its commands."""
    for name in PROGRAMS:
        yield from _below(typer.main.get_command(import_module(f"{name}.cli").app), (name,))


def fields_page() -> str:
    """docs/fields.md."""
    lines = ["| field | axes | type | unit | stored | in memory | on disk | meaning |"]
    lines.append("| --- | --- | --- | --- | --- | ---: | ---: | --- |")
    for field in FIELDS.values():
        per = "" if TIME in field.dims else " a sequence"
        sizes = " | ".join(f"{amount(size)}{per}" for size in field_bytes(field, 1, (480, 640)))
        columns = (", ".join(field.dims), field.dtype, field.unit, STORED_WHEN[field.stored])
        words = (f"`{field.name}`", *columns, sizes, field.meaning)
        lines.append(f"| {' | '.join(words)} |")
    return _FIELDS_HEAD + "\n".join(lines) + "\n" + _FIELDS_FOOT


_FIELDS_HEAD = """\
# What a sequence holds

Written by `make docs`; do not edit. Sizes: a frame of 640 x 480 px; on disk by the ratio measured on rendered
sequences.

Camera axes are x right, y down, z away from the camera: a press has a positive z in `force` and `traction`.
Both are the instruments' alone, without the pressure of a pulse.

`store.flow: float16` halves the flows. A value is then rounded to 11 bits: by 0.004 px at most below 16 px of
motion, 0.008 px below 32. The largest error of a sequence is measured while it is written: attribute
`summary.rounding_px`. Flows are read as float32 either way.

`render.stereo_mm: B` adds a right camera, B mm to the right of the left one. Their axes are parallel, focal
length f = `K[0,0]` and distortion are the same. The right principal point is shifted so that both pictures
show the same field:

    K_right[0,2] = K[0,2] + f B / z,    translation_right = translation - (B, 0, 0),

z being the distance of the craniotomy's centre along the axis. The attribute `right` holds `K`, `distortion`,
`rotation`, `translation` and `baseline_mm`. Without distortion a point is on the same row of both pictures,
and its depth is

    Z = f B / (disparity + K_right[0,2] - K[0,2]).

*Camera axes* are OpenCV's: x right, y down, z away from the camera. Those of `force` and `traction` are of
the camera at rest, of `motion` each frame's own. They differ only where the camera moves.

"""
_FIELDS_FOOT = """
## Attributes

Of a sequence, `sequence.attrs`:

| attribute | meaning |
| --- | --- |
| `index`, `seed`, `job` | number in the dataset, the job's seed, hash of the job |
| `frames`, `fps`, `size` | number of frames, frames a second, width and height [px] |
| `young_kpa`, `poisson` | of the tissue |
| `scale_mm_per_px` | at the craniotomy's centre |
| `K`, `distortion` | intrinsic matrix [px], and k1, k2, p1, p2, k3 of OpenCV |
| `rotation`, `translation` | from world axes to the camera at rest [mm] |
| `mesh_to_world` | from the axes of a mesh of yours |
| `right` | the same of a right camera, and `baseline_mm` |
| `anatomy_id`, `opening_id` | shared by sequences of one brain, of one opening; splits keep them together |
| `scenario` | what was drawn: gestures (instrument, load, times), tissue, view, appearance, pulse |
| `mechanics` | by frame energy [mN mm], smallest J, residual; `cautions` of another program's |
| `flow_backend`, `variant`, `versions` | flow estimator, renderer's variant, versions of packages and code |
| `summary` | largest flow, motion, force and traction, rounding of flows |
| `timings` | CPU and wall time by stage [s], peak memory [MB] |
| `content_hash`, `field_hashes`, `seal_hash` | of all but `timings`, of each field, of the attributes |
| `format`, `format_version` | of the store |
"""


_PROTOCOL_HEAD = """\
# A first specimen

This protocol takes an afternoon. It leads to a recording from which force can be estimated and scored.
`bench init --protocol RECORDING` writes the list at the end of this page into the recording's folder;
`bench check RECORDING` says which of the ten steps that files show a recording has, and what each missing
one costs. The keys are those of [`meta.yaml`](../reference/recording.md). In surgery, without a sensor, what
counts is: camera, second camera, scale, rest and outline; for stiffness and membrane state ranges
([which](../faq.md)). The list is written by `make docs` from `bench/checks/protocol.yaml`.

## Settings

| | recommended | the published experiment (Heraoui et al.) |
| --- | --- | --- |
| camera | a stereo microscope, both cameras recorded | one endoscope |
| frames a second | 20 or more | 23 |
| picture | 640 × 480 px or more, tissue from edge to edge | 680 × 480 px |
| force sensor | at least 10 times the frame rate, noise below 1% of the largest force | SensONE |
| clocks | one clock, or taps | |
| stiffness | measured next to the site | 0.5 kPa throughout |

Scale, stiffness and a second camera decide most: force is proportional to stiffness (a membrane's is its
own) and to the square of the scale, and one camera hardly measures force along its line of sight. What each
further statement in `meta.yaml` gains, on 12 rendered recordings of 3 s: mean error in % of the peak force
([measured](../results/scoring/stability/README.md)):

| stated, with all above | two cameras: bare tissue; membrane; pulse | one camera |
| --- | --- | --- |
| scale and stiffness | 4; 21; 20 | 17; 30; 9 |
| tissue and instruments | 6; 19; 12 | 15; 26; 17 |
| 0.1 to 0.4 s without contact | 6; 19; 12 | 15; 26; 17 |
| whether the membrane is intact | 6; 12; 11 | 8; no interval; 12 |

A span this short shows too little of a breath, and gains nothing. Hence the three breaths below.

## Steps

"""


def pages() -> dict[Path, str]:
    """The generated pages: path and text."""
    return {
        DOCS / "fields.md": fields_page(),
        DOCS / "reference" / "job.md": _job(),
        DOCS / "reference" / "recording.md": _recording(),
        DOCS / "reference" / "commands.md": _commands(),
        DOCS / "reference" / "python.md": api_page.write_page(_WRITTEN),
        DOCS / "howto" / "protocol.md": _PROTOCOL_HEAD + protocol.as_markdown(),
        ROOT / "CONTRIBUTING.md": _contributing(),
        ROOT / "mkdocs.yml": _site(),
    }


def _below(click: Any, words: tuple[str, ...]) -> Iterator[Command]:
    command = Command(words, click)
    yield command
    if command.group:
        context = click.make_context(words[-1], [], resilient_parsing=True)
        for name in click.list_commands(context):
            yield from _below(click.get_command(context, name), (*words, name))


def _job() -> str:
    head = [
        "# The job file",
        "",
        f"{_WRITTEN} `synth new job.yaml` writes the same as a file to edit; `synth schema`",
        "prints the JSON schema for editors. Every key may be left out; on the command line a key is",
        "`section.key=value`.",
        "A range is `[low, high]`, drawn anew for each sequence; a single number is a fixed value.",
    ]
    return "\n".join([*head, *_keys(Job(), "")]) + "\n"


def _recording() -> str:
    head = [
        "# A recording's meta.yaml",
        "",
        f"{_WRITTEN} The other files of a recording folder: [Your own recording](../howto/recording.md).",
    ]
    return "\n".join([*head, *_keys(Meta.model_construct(), "")]) + "\n"


def _keys(section: BaseModel, prefix: str) -> list[str]:
    """A table of a section's keys, followed by the tables of its subsections."""
    rows: list[str] = []
    subsections: list[str] = []
    for name, field in type(section).model_fields.items():
        default = field.get_default(call_default_factory=True)
        below = section_of(field.annotation)
        if isinstance(default, BaseModel):
            subsections += ["", f"## {prefix}{name}", "", _sentence(type(default).__doc__)]
            subsections += _keys(default, f"{prefix}{name}.")
            continue
        meaning = _sentence(field.description or (below.__doc__ if below else ""))
        limits = job_writer.limits(type(section), name)
        if limits:
            meaning += f" {limits}"
        value = "" if field.is_required() else job_writer.scalar(default)
        default_text = "needed" if field.is_required() else f"`{value}`" if value else "–"
        rows.append(f"| `{name}` | {default_text} | {_cell(meaning)} |")
        if below is not None:
            is_list = "tuple" in str(field.annotation)
            subsections += [
                "",
                f"## {prefix}{name}{', each of them' if is_list else ''}",
                "",
                _sentence(below.__doc__),
            ]
            subsections += _keys(below.model_construct(), "" if is_list else f"{prefix}{name}.")
    table = ["", "| key | default | meaning |", "| --- | --- | --- |", *rows] if rows else []
    return [*table, *subsections]


def _sentence(text: str | None) -> str:
    return " ".join((text or "").split())


def _cell(text: str) -> str:
    return _sentence(text).replace("|", r"\|")


def _commands() -> str:
    lines = ["# Commands", "", f"{_WRITTEN} Every command has `--help`."]
    for command in commands():
        name = " ".join(command.words)
        lines += ["", f"{'##' if command.group else '###'} {name}", "", _sentence(command.click.help)]
        if command.group:
            continue
        for line in command.examples:
            lines += ["", f"    {line}"]
        rows = [_parameter(parameter) for parameter in command.click.params if parameter.name != "help"]
        if rows:
            lines += ["", "| parameter | default | meaning |", "| --- | --- | --- |", *rows]
    return "\n".join(lines) + "\n"


def _parameter(parameter: Any) -> str:
    option = parameter.param_type_name == "option"
    names = [*parameter.opts, *parameter.secondary_opts] if option else [parameter.name.upper()]
    default = parameter.default() if callable(parameter.default) else parameter.default
    if isinstance(default, (list, tuple)):
        default = " ".join(str(part) for part in default)
    if parameter.required:
        default_text = "needed"
    elif default in (None, "", False) or getattr(parameter, "is_flag", False):
        default_text = "–"
    else:
        default_text = f"`{getattr(default, 'value', default)}`"
    return f"| {', '.join(f'`{name}`' for name in names)} | {default_text} | {_cell(parameter.help)} |"


def _contributing() -> str:
    """CONTRIBUTING.md with its table of packages."""
    path = ROOT / "CONTRIBUTING.md"
    head, _, rest = path.read_text("utf-8").partition(_TABLE[0])
    rows = [
        f"| `{name.replace('.', '/')}` | {_cell(purpose)} | {imports} |"
        for name, purpose, imports in _packages()
    ]
    table = ["", "| package | what | imports from |", "| --- | --- | --- |", *rows, ""]
    return f"{head}{_TABLE[0]}\n" + "\n".join(table) + "\n" + _TABLE[1] + rest.partition(_TABLE[1])[2]


def _packages() -> Iterator[tuple[str, str, str]]:
    """Each package: dotted name, purpose, packages that its files import from."""
    paths = [path.parent for name in PACKAGES for path in sorted((ROOT / name).rglob("__init__.py"))]
    folders = {".".join(path.relative_to(ROOT).parts): path for path in paths}
    for name, folder in folders.items():
        trees = {path.stem: ast.parse(path.read_text("utf-8")) for path in folder.glob("*.py")}
        imports = {_package(module, folders) for tree in trees.values() for module in _list_imports(tree)} - {
            "",
            name,
        }
        home = name.partition(".")[0]
        inside = sorted(package.partition(".")[2] for package in imports if package.startswith(f"{home}."))
        others = [
            package
            for package in PACKAGES
            if package != home and any(f"{imported}.".startswith(f"{package}.") for imported in imports)
        ]
        links = ", ".join(f"`{package}`" for package in [*others, *inside])
        yield (
            name,
            ast.get_docstring(trees["__init__"]) or "",
            "its own packages" if name in PROGRAMS else links or "–",
        )


def _list_imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _package(module: str, folders: dict[str, Path]) -> str:
    """The package that a module belongs to; empty for a module of others."""
    return max((name for name in folders if f"{module}.".startswith(f"{name}.")), key=len, default="")


_TITLES = {
    "exvivo": "Ex vivo stand-ins",
    "fem": "Physics",
    "flow": "Optical flow and stereo",
    "gap": "Sim-to-real gap",
    "inverse": "Force by physics alone",
    "learn": "Networks",
    "scoring": "Cost of scoring",
    "tune": "Choice of fidelity",
}


def _site() -> str:
    """mkdocs.yml with a line for each folder of docs/results."""
    head = (ROOT / "mkdocs.yml").read_text("utf-8").partition(_LISTED)[0]
    pages = sorted((DOCS / "results").glob("*/README.md"))
    titles = {page: page.parent.name.replace("-", " ").capitalize() for page in pages}
    lines = [
        f"{_LISTED}: the folders of docs/results.",
        "  - Results:",
        "      - results/README.md",
        *(
            f"      - {_TITLES.get(page.parent.name, titles[page])}: {page.relative_to(DOCS).as_posix()}"
            for page in pages
        ),
        "",
        "exclude_docs: |",
        "  *.py",
    ]
    return head + "\n".join(lines) + "\n"


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")
            print(f"wrote {path.relative_to(DOCS.parent)}")
