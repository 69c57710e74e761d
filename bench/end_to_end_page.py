"""The page, chart and README of `bench pareto end-to-end`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench import machine, plot

_SHOWN = ("law", "tets", "spp", "flow", "model", "default", "cpu_s", "data_s", "flow_s", "answer_s", "rmse")


def write(found: dict[str, Any], out: Path) -> None:
    """`chart.svg`, `index.html` and `README.md` in the folder `out`."""
    rows = [{name: row[name] for name in _SHOWN} for row in found["rows"]]
    plot.write(panels(found), out, "End to end: error of the force against cost", rows, found)
    (out / "README.md").write_text(readme(found), "utf-8")


def panels(found: dict[str, Any]) -> list[plot.Panel]:
    """The chart of `pareto.json`: a curve a model, a dot a pipeline."""
    curves = []
    for model in dict.fromkeys(row["model"] for row in found["rows"]):
        own = [row for row in found["rows"] if row["model"] == model]
        curves.append(
            plot.Curve(
                model,
                tuple(float(row["cpu_s"]) for row in own),
                tuple(100 * float(row["rmse"]) for row in own),
                tuple(_words(row) for row in own),
                ringed=tuple(k for k, row in enumerate(own) if row["default"]),
                ends=tuple((100 * float(row["low"]), 100 * float(row["high"])) for row in own),
            )
        )
    title = "End to end: error of the force against cost"
    return [
        plot.Panel(title, "CPU s a frame", "RMSE of the force [%]", tuple(curves), True, True, front=True)
    ]


def readme(found: dict[str, Any]) -> str:
    """What was measured, as a table, the cheapest first."""
    asked = found["asked"]
    lines = [
        "# End to end: error of the force against cost, whole pipelines",
        "",
        f"    {found['command']}",
        "",
        f"Machine: {machine.line(found['machine'])}. {found['meaning']}.",
        "",
        f"All are asked about the same sequences, made with {asked['law']}, {asked['tets']} tetrahedra "
        f"and {asked['spp']} paths a pixel, scenes that no pipeline has seen, from the flow that their own "
        "estimator recovers there (those fitted on ideal flow: the default one). Physics alone learns "
        "nothing and is one dot a flow. Defaults are bold.",
        "",
        "![Error against cost](chart.svg)",
        "",
        "| law | tets | spp | flow | model | CPU s a frame | RMSE of the force |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in sorted(found["rows"], key=lambda row: float(row["cpu_s"])):
        error = f"{100 * row['rmse']:.0f}% [{100 * row['low']:.0f}, {100 * row['high']:.0f}]"
        cells = [row["law"], row["tets"], row["spp"], row["flow"], row["model"], f"{row['cpu_s']:.3f}", error]
        words = [f"**{cell}**" if row["default"] else str(cell) for cell in cells]
        lines.append(f"| {' | '.join(words)} |")
    if found["missing"]:
        lines += ["", f"Not measured, the run was stopped before: {'; '.join(found['missing'])}."]
    return "\n".join(lines) + "\n"


def _words(row: dict[str, Any]) -> str:
    return f"{row['law']} {row['tets']}, {row['spp']} spp, {row['flow']}"
