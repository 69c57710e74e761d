"""The page of the look: texture, classifier and fit, from the data that lie in one folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.output.charts import Chart, Row
from bench.output.result_page import Page, Section
from evidence.defaults_on_front import read

Tree = Mapping[str, Any]


def drawn(folder: Path) -> Page:
    """A chart for each of the experiments that are there."""
    found = {file.stem: read(file) for file in sorted(folder.glob("*.json"))}
    charts, tables = [], []
    for name, draw in (("texture", _texture), ("classifier", _classifier), ("fit", _fit)):
        if name in found:
            chart, table = draw(found[name])
            charts.append(chart)
            tables.append(table)
    commands = "; ".join(one["command"] for one in found.values())
    machine = next(iter(found.values()))["machine"]
    return Page("The look against a photograph", {"machine": machine}, charts, tables, command=commands)


def _texture(found: Tree) -> tuple[Chart, Section]:
    """Median and 80% of the crops, by source."""
    rows = tuple(Row(one["crops"], one["median"], (one["p10"], one["p90"])) for one in found["rows"])
    unit = "distance in spreads of the photograph's crops: median, from p10 to p90"
    limit = found["limit_p90_of_photograph"]
    return Chart(f"Texture: within the photograph's own at most {limit}", unit, rows), Section(
        "Texture", found["rows"]
    )


def _classifier(found: Tree) -> tuple[Chart, Section]:
    """AUC by source, from the lowest to the highest fold."""
    rows = tuple(Row(one["crops"], one["auc"], (one["lowest"], one["highest"])) for one in found["rows"])
    unit = "held-out AUC: mean, lowest to highest of five folds"
    return Chart("Classifier: 0.5 where crops can't be told apart", unit, rows), Section(
        "Classifier", found["rows"]
    )


def _fit(found: Tree) -> tuple[Chart, Section]:
    """Distance from each picture, after as a part of before."""
    rows = tuple(Row(one["picture"], one["ratio"]) for one in found["pictures"])
    chart = Chart("Fit: half of what it was, or less", "distance after the fit / before", rows)
    return chart, Section("Fit", found["pictures"])
