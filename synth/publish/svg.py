"""Charts by matplotlib as small, reproducible SVG, independent of the user's settings; text stays text."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE: Any = {
    "svg.hashsalt": "sulcus",
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.sans-serif": ["DejaVu Sans"],
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    # Gridlines instead of ticks: one line less per tick in the file.
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e8eb",
    "axes.edgecolor": "#c9ced6",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.bottom": False,
    "ytick.left": False,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.constrained_layout.h_pad": 0.1,
    "lines.markersize": 5,
    "legend.frameon": False,
    "legend.fontsize": 9,
}
_LONG = re.compile(r"\d+\.\d{3,}")


def svg(width: float, height: float, draw: Callable[[Figure], None]) -> str:
    """The figure drawn by `draw`, of that size in points (1/72 inch), as the text of an SVG element."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(figsize=(width / 72, height / 72), layout="constrained")
        draw(figure)
        file, metadata = io.StringIO(), dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(file, format="svg", metadata=metadata)
    return _slim(file.getvalue())


def _slim(text: str) -> str:
    """The SVG at half its size: no prologue, comments and metadata, numbers rounded to a tenth of a point.

    Rounded off round numbers, as last bits differ from run to run; parts are named by the content, so that
    several pictures can be on one page.
    """
    text = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r' transform="rotate\(-0 [^"]*"|(?<=<g) id="[^"]*"', "", text)
    shorten = partial(_LONG.sub, lambda number: f"{float(number[0]) + 0.0123:.1f}".removesuffix(".0"))
    text = re.sub(r"<[^>]+>", lambda tag: shorten(tag[0]), text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    parts = dict.fromkeys(re.findall(r' id="(\w+)"', text))
    mark = f"{zlib.crc32(re.sub('|'.join(parts) or '$', '', text).encode()):x}"
    for k, part in enumerate(parts):
        text = text.replace(part, f"p{mark}-{k}")
    return text
