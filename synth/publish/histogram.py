"""Histograms as small self-contained SVG pictures, for cards and pages that must open anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from synth.publish.svg import svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH, _HEIGHT = 320, 180
_COLOUR = "#3b6ea5"


def histogram(values: NDArray[np.floating], title: str, unit: str, bins: int = 24) -> str:
    """Histogram of (N,) values as SVG; the title says how many there are."""
    values = values[np.isfinite(values)]
    counts, edges = np.histogram(values, bins)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.bar(edges[:-1], counts, 0.94 * np.diff(edges), align="edge", color=_COLOUR)
        axes.set(title=f"{title} (n = {len(values)})", xlabel=unit)
        axes.grid(visible=False, axis="x")
        axes.locator_params(axis="x", nbins=4)
        axes.locator_params(axis="y", nbins=3, integer=True)

    return svg(_WIDTH, _HEIGHT, draw)


def bars(counts: Sequence[int], labels: Sequence[str], title: str) -> str:
    """A bar for every count, from the top down, its label beside it."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.bar_label(axes.barh(labels, counts, color=_COLOUR), padding=2)
        axes.set(title=title)
        axes.invert_yaxis()
        axes.grid(visible=False)
        axes.margins(x=0.15)
        axes.xaxis.set_visible(False)

    return svg(_WIDTH, _HEIGHT, draw)
