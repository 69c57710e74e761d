"""A page with the brain to turn: a click on it gives the job's lines of the nearest opening that works."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from synth.place.openings import Survey, lines
from synth.place.picture import thinned
from synth.system.whole_file import write_whole

_FACES = 15_000


def write_page(found: Survey, path: Path) -> None:
    """Writes the page, which stands alone, whole or not at all."""
    write_whole(path, render_page(found, path.parent), durable=False)


def render_page(found: Survey, folder: Path) -> str:
    """The page as text; the job's lines are for a file in `folder`."""
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=PackageLoader("synth.place", "."),
        autoescape=select_autoescape(default_for_string=True, default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    vertices, faces = thinned(found.vertices, found.faces, _FACES)
    sites = [
        {
            "point": np.round(site.point, 2).tolist(),
            "direction": np.round(site.direction, 3).tolist(),
            "rank": rank,
            "fault": site.fault,
            "cut": site.cut,
            "relief": None if not np.isfinite(site.relief_mm) else round(site.relief_mm, 2),
            "lines": "" if site.fault else lines(found.path, site, found.radius_mm, folder),
        }
        for rank, site in [
            *((k, site) for k, site in enumerate(found.chosen, 1)),
            *((0, site) for site in found.others),
        ]
    ]
    told = {
        "x": np.round(vertices, 2).T.tolist(),
        "faces": faces.T.tolist(),
        "sites": sites,
        "radius": found.radius_mm,
    }
    return environment.get_template("page.html.jinja").render(
        name=found.path.name,
        radius=f"{found.radius_mm:g}",
        plotly=get_plotlyjs(),
        # "</" would end the script element early.
        data=json.dumps(told, allow_nan=False).replace("</", "<\\/"),
    )
