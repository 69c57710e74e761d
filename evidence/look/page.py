"""The page of the look: texture, classifier and fit, from the data that lie in one folder."""

from __future__ import annotations

from pathlib import Path

from bench.output.charts import Chart, Row
from bench.output.result_page import Page, Section
from evidence.defaults_on_front import read

_TABLES = {
    "texture": ("rows",),
    "classifier": ("rows", "linear", "cues"),
    "fit": ("pictures", "parameters"),
}


def drawn(folder: Path) -> Page:
    """The texture's distances as a picture, and a table for each of the experiments that are there."""
    found = {file.stem: read(file) for file in sorted(folder.glob("*.json"))}
    charts = []
    if "texture" in found:
        # Median and 80% of the crops, by source.
        rows = tuple(
            Row(one["crops"], one["median"], (one["p10"], one["p90"])) for one in found["texture"]["rows"]
        )
        unit = "distance in spreads of the photograph's crops: median, from p10 to p90"
        limit = found["texture"]["limit_p90_of_photograph"]
        charts.append(Chart(f"Texture: within the photograph's own at most {limit}", unit, rows))
    tables = [
        Section(name if key == keys[0] else f"{name}: {key}", found[name][key])
        for name, keys in _TABLES.items()
        for key in keys
        if found.get(name, {}).get(key)
    ]
    commands = "; ".join(one["command"] for one in found.values())
    machine = next(iter(found.values()))["machine"]
    return Page("The look against a photograph", {"machine": machine}, charts, tables, command=commands)
