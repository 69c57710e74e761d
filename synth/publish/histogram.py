"""Histograms as small self-contained SVG pictures, for cards and pages that must open anywhere."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_WIDTH, _HEIGHT = 320, 180
_LEFT, _RIGHT, _TOP, _BOTTOM = 40, 10, 26, 38
_COLOUR = "#3b6ea5"


def histogram(values: NDArray[np.floating], title: str, unit: str, bins: int = 24) -> str:
    """Histogram of (N,) values as SVG; the axis says the range, the title says how many there are."""
    values = values[np.isfinite(values)]
    if not len(values):
        return bars([], [], title, unit)
    low, high = float(values.min()), float(values.max())
    spread = (low, high) if high > low else (low - 0.5, high + 0.5)
    counts, edges = np.histogram(values, bins=bins, range=spread)
    labels = [f"{edges[0]:.3g}", f"{(edges[0] + edges[-1]) / 2:.3g}", f"{edges[-1]:.3g}"]
    return bars(counts.tolist(), labels, f"{title} (n = {len(values)})", unit)


def bars(counts: Sequence[int], labels: Sequence[str], title: str, unit: str) -> str:
    """A bar for every count; labels are spread evenly under the axis."""
    wide, tall = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    largest = max([*counts, 1])
    step = wide / max(len(counts), 1)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" '
        f'height="{_HEIGHT}" font-family="sans-serif" font-size="11" fill="#444">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        f'<text x="{_LEFT}" y="16" font-size="12">{html.escape(title)}</text>',
        f'<text x="{_LEFT - 4}" y="{_TOP + 9}" text-anchor="end">{largest}</text>',
    ]
    for k, count in enumerate(counts):
        height = tall * count / largest
        parts.append(
            f'<rect x="{_LEFT + k * step + 0.5:.1f}" y="{_TOP + tall - height:.1f}" '
            f'width="{max(step - 1, 0.5):.1f}" height="{height:.1f}" fill="{_COLOUR}"/>'
        )
    base = _TOP + tall
    parts.append(f'<line x1="{_LEFT}" x2="{_LEFT + wide}" y1="{base}" y2="{base}" stroke="#888"/>')
    for k, label in enumerate(labels):
        at = _LEFT + wide * k / max(len(labels) - 1, 1)
        anchor = "start" if k == 0 else "end" if k == len(labels) - 1 else "middle"
        parts.append(f'<text x="{at:.0f}" y="{base + 14}" text-anchor="{anchor}">{html.escape(label)}</text>')
    parts.append(
        f'<text x="{_LEFT + wide / 2:.0f}" y="{base + 30}" text-anchor="middle">{html.escape(unit)}</text>'
    )
    return "\n".join([*parts, "</svg>"]) + "\n"
