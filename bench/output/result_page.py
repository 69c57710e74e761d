"""The page of an experiment's results: what made them, pictures, tables; and the pictures as one drawing."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.output import forest_plot, plot
from bench.output import write as results

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Chart:
    """One picture: a line a value."""

    title: str
    unit: str
    rows: tuple[forest_plot.Row, ...]

    def drawing(self) -> str:
        return forest_plot.draw(self.rows, self.title, self.unit)


@dataclass(frozen=True)
class Sheet:
    """What a folder of results shows."""

    title: str
    command: str
    found: Mapping[str, Any]
    """The data: machine and seed, if they are in it, stand under the title."""
    charts: tuple[Chart | plot.Panel, ...]
    tables: tuple[tuple[str, Rows], ...] = field(default=())
    """Each with its heading."""

    def files(self) -> dict[str, str]:
        """Text of `chart.svg`, if there is a chart, and of `index.html`."""
        drawings = [plot.drawing([c]) if isinstance(c, plot.Panel) else c.drawing() for c in self.charts]
        seed = f"<p>seed {self.found['seed']}</p>" if "seed" in self.found else ""
        parts = [plot.credit({**self.found, "command": self.command}), seed, *drawings]
        for heading, rows in self.tables:
            parts += [f"<h2>{html.escape(heading)}</h2>", plot.table(rows)] if rows else []
        page = {"index.html": plot.page(self.title, "\n".join(part for part in parts if part))}
        return ({"chart.svg": together(drawings)} if drawings else {}) | page


def together(drawings: Sequence[str]) -> str:
    """SVGs one below the other, as one."""
    sizes = [_size(one) for one in drawings]
    wide, tall = max(w for w, _ in sizes), sum(h for _, h in sizes)
    top, parts = 0.0, []
    for one, (w, h) in zip(drawings, sizes, strict=True):
        # The inner picture's own width, height and style would fight with the place it is given.
        inner = _OPENING.sub("", one.strip(), count=1)
        parts.append(
            f'<svg x="0" y="{top:g}" width="{w:g}" height="{h:g}" viewBox="0 0 {w:g} {h:g}" {_FONT}>'
        )
        parts.append(inner)
        top += h
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:g} {tall:g}" {_FONT}>'
    return (
        "\n".join([head, f'<rect width="{wide:g}" height="{tall:g}" fill="#fff"/>', *parts, "</svg>"]) + "\n"
    )


def bars(
    values: Mapping[str, float], ends: Mapping[str, tuple[float, float]] | None = None
) -> tuple[forest_plot.Row, ...]:
    """A line a value, with its interval where there is one."""
    known = ends or {}
    nan = (float("nan"), float("nan"))
    return tuple(forest_plot.Row(name, float(value), known.get(name, nan)) for name, value in values.items())


def flat(tree: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What a result says in single values, as rows of two columns; lists and the machine are left out."""
    rows: list[dict[str, Any]] = []

    def walk(node: Mapping[str, Any], before: str) -> None:
        for key, value in node.items():
            if isinstance(value, Mapping) and key != "machine":
                walk(value, f"{before}{key}: ")
            elif not isinstance(value, (list, Mapping)):
                rows.append({"what": f"{before}{key}", "value": value})

    walk(tree, "")
    return rows


def write(sheet: Sheet, folder: Path) -> list[str]:
    """Writes its files into `folder`; gives back the names of those that changed."""
    changed = {name: text for name, text in sheet.files().items() if not _same(folder / name, text)}
    for name, text in changed.items():
        results.keep(folder, name, text)
    return list(changed)


def stale(sheet: Sheet, folder: Path) -> list[str]:
    """Names of the files in `folder` that are not what the sheet says."""
    return [name for name, text in sheet.files().items() if not _same(folder / name, text)]


_OPENING = re.compile(r"<svg[^>]*>")
_FONT = 'font-family="sans-serif" font-size="12" fill="#22262b"'


def _size(drawing: str) -> tuple[float, float]:
    found = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', drawing)
    if found is None:
        raise ValueError("a drawing without a viewBox")
    return float(found[1]), float(found[2])


def _same(file: Path, text: str) -> bool:
    return file.is_file() and file.read_text("utf-8") == text
