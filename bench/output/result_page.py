"""What an experiment's folder shows, as a page to open (`index.html`) or to read (`README.md`)."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from bench.output import write as results
from bench.output.charts import Chart, Panel, curves, intervals

Rows = Sequence[Mapping[str, Any]]
_NAMES = ("chart.svg", "intervals.svg")


@dataclass(frozen=True)
class Section:
    """A table with its heading and what is said of it; any of them may be empty."""

    heading: str
    rows: Rows = ()
    words: Sequence[str] = ()
    """Paragraphs; one that begins with "- " is an item of a list."""

    @property
    def columns(self) -> list[str]:
        """Keys of all rows, but for those of trees, which are no cells."""
        names = dict.fromkeys(name for row in self.rows for name in row)
        return [name for name in names if not any(isinstance(row.get(name), Mapping) for row in self.rows)]


@dataclass(frozen=True)
class Page:
    """What made the data, pictures, tables."""

    title: str
    found: Mapping[str, Any]
    """The data: its command, machine and seed are said if they are in it."""
    charts: Sequence[Chart | Panel] = ()
    """Intervals and curves, a picture each kind."""
    sections: Sequence[Section] = ()
    words: Sequence[str] = ()
    """Said before all else; may hold `code` and *emphasis*."""
    command: str = ""
    """Where the data don't name it; several are parted by "; "."""
    name: str = "index.html"
    """Of the page's file; an ending `.md` makes it Markdown."""
    links: Sequence[str] = ()
    """Pictures that other pages have made."""

    @property
    def commands(self) -> list[str]:
        """What was typed."""
        said = self.command or str(self.found.get("command", ""))
        return said.split("; ") if said else []

    @property
    def made(self) -> str:
        """Machine and seed."""
        machine = ", ".join(f"{key} {value}" for key, value in self.found.get("machine", {}).items())
        seed = f"Seed {self.found['seed']}." if "seed" in self.found else ""
        return f"{f'Machine: {machine}.' if machine else ''} {seed}".strip()

    @property
    def pictures(self) -> list[str]:
        """Files that the page shows."""
        return [*_NAMES[: len({type(one) for one in self.charts})], *self.links]

    def text(self) -> str:
        """The page as HTML or as Markdown, whichever the name of its file says."""
        kind = self.name.rpartition(".")[2]
        environment = jinja2.Environment(
            loader=jinja2.PackageLoader("bench.output", "."),
            autoescape=kind == "html",
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            keep_trailing_newline=True,
        )
        environment.filters |= {"cell": _cell, "spans": _spans, "table": markdown}
        return environment.get_template(f"page.{kind}.jinja").render(page=self)

    def files(self) -> dict[str, str]:
        """Text of the page and of its own pictures, by name."""
        return {self.name: self.text()} | self._drawn()

    def _drawn(self) -> dict[str, str]:
        panels = [one for one in self.charts if isinstance(one, Panel)]
        rows = [one for one in self.charts if isinstance(one, Chart)]
        drawn = ([curves(panels)] if panels else []) + ([intervals(rows)] if rows else [])
        return dict(zip(_NAMES, drawn, strict=False))


def markdown(rows: Rows) -> str:
    """A table in Markdown, columns being the keys of all rows."""
    names = Section("", rows).columns
    lines = [names, ["---"] * len(names), *([_cell(row.get(name)) for name in names] for row in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def write(page: Page, folder: Path) -> list[str]:
    """Writes its files into `folder`; gives back the names of those that changed."""
    changed = _changed(page, folder)
    for name, text in changed.items():
        results.keep(folder, name, text)
    return list(changed)


def stale(page: Page, folder: Path) -> list[str]:
    """Names of the files in `folder` that are not what the page says."""
    return list(_changed(page, folder))


def _changed(page: Page, folder: Path) -> dict[str, str]:
    def same(name: str, text: str) -> bool:
        return (folder / name).is_file() and (folder / name).read_text("utf-8") == text

    return {name: text for name, text in page.files().items() if not same(name, text)}


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _spans(line: str) -> Markup:
    """Markdown's `code` and *emphasis* as HTML."""
    text = html.escape(line, quote=False)
    for mark, tag in (("`", "code"), (r"\*", "em")):
        text = re.sub(f"{mark}(.+?){mark}", rf"<{tag}>\1</{tag}>", text)
    return Markup(text)
