"""Equations of the pages as MathML, which needs no script. Zensical calls this (`mkdocs.yml`)."""

from __future__ import annotations

from typing import Any

from latex2mathml.converter import convert


def mathml(source: str, *_: Any, **__: Any) -> str:
    """A displayed equation of LaTeX, from a fence named `math`, which GitHub shows as well."""
    return f'<p class="equation">{convert(source.strip(), display="block")}</p>'
