"""Charts by matplotlib as small SVG text: same data, same bytes, whoever's settings; text stays text."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Callable
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
    # Gridlines stand for ticks: one line less a tick in the file.
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
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))


def svg(width: float, height: float, draw: Callable[[Figure], None]) -> str:
    """What `draw` puts on an empty figure of so many points (1/72 inch), as the text of an SVG element."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(figsize=(width / 72, height / 72), layout="constrained")
        draw(figure)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata=_NO_METADATA)
    return _slim(file.getvalue())


def _slim(text: str) -> str:
    """About a third as long: without prologue, comments and metadata, styles that recur said once.

    A tenth of a point is as little as can be seen; where to cut lies beside the round numbers, as the
    layout's last bits differ from run to run. Names of styles and of parts are made from the content, so that
    several pictures may stand in one page.
    """
    styles: dict[str, str] = {}

    def named(found: re.Match[str]) -> str:
        name = f"s{zlib.crc32(found[1].encode()):x}"
        styles[name] = found[1]
        return f'class="{name}"'

    text = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r' transform="rotate\(-0 [^"]*"|(?<=<g) id="[^"]*"', "", text)
    text = re.sub(r"<[^>]+>", lambda tag: _LONG.sub(_short, tag[0]), text)
    text = re.sub(r'style="([^"]*)"', named, text)
    # A path's letters part its numbers well enough.
    text = re.sub(r'(?<= d=")[^"]*', lambda path: re.sub(r"\s*([A-Za-z])\s*", r"\1", path[0]), text)
    rules = "".join(f".{name}{{{style}}}" for name, style in styles.items())
    text = re.sub(r"\s*\n\s*", "\n", text.replace("</style>", f"{rules}</style>", 1))
    text = re.sub(r"<g>\n(<(?:text|path)[^<]*(?:/>|</text>))\n</g>", r"\1", text)
    parts = dict.fromkeys(re.findall(r' id="(\w+)"', text))
    mark = f"{zlib.crc32(re.sub('|'.join(parts) or '$', '', text).encode()):x}"
    for k, part in enumerate(parts):
        text = text.replace(part, f"p{mark}-{k}")
    return text


def _short(number: re.Match[str]) -> str:
    return f"{float(number[0]) + 0.0123:.1f}".removesuffix(".0")
