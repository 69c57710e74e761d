"""What `bench pareto end-to-end` shows: charts, verdicts and a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bench.output import charts, result_page

_WHAT = {"": ("the force", "zero"), "across_": ("the force across the line of sight", "across_zero")}
"""By prefix of the names in a row: what is meant, and under which name the error of saying nothing is."""
_COSTS = {"": "cpu_s", ", of it data": "data_s", ", flow": "flow_s", ", answer": "answer_s"}
_MEAN = (
    "The mean over sequences of each one's own ratio is taken, not one ratio over all frames: force goes "
    "with E and the contact's area, so a few stiff, broad contacts would hold most of the pooled square."
)
_UNIT = "more error than the defaults [% of the force], 95% interval"


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `pareto.json` says, the cheapest pipeline first."""
    asked, rows = found["asked"], sorted(found["rows"], key=lambda row: float(row["cpu_s"]))
    return result_page.Page(
        "End to end: error of the force against cost, whole pipelines",
        found,
        [*panels(found), *differences(found)],
        (
            result_page.Section("", words=[f"- {line}" for line in verdicts(found)]),
            result_page.Section("Pipelines", [_line(row) for row in rows], (_MEAN,)),
        ),
        (
            f"{found['meaning']}.",
            f"All are asked about the same {len(rows[0]['errors'])} sequences, made with {asked['law']}, "
            f"{asked['tets']} tetrahedra and {asked['spp']} paths a pixel, scenes that no pipeline has "
            "seen, from the flow that their own estimator recovers there (those fitted on ideal flow: the "
            "default one). Physics alone learns nothing and is one dot a flow. Intervals are BCa over "
            "sequences; the difference is to the defaults with the same model on the same sequences, and "
            "tells far more than two intervals that overlap. No force at all errs by 100%.",
        ),
        name="README.md",
    )


def panels(found: Mapping[str, Any]) -> list[charts.Panel]:
    """The charts of `pareto.json`, of the whole force and of its part across the line of sight.

    A curve a model, a dot a pipeline; and what saying nothing errs by.
    """
    rows = found["rows"]
    costs = [float(row["cpu_s"]) for row in rows]
    made = []
    for name, (what, nothing) in _WHAT.items():
        curves = []
        for model in dict.fromkeys(row["model"] for row in rows):
            own = [row for row in rows if row["model"] == model]
            curves.append(
                charts.Curve(
                    model,
                    tuple(float(row["cpu_s"]) for row in own),
                    tuple(100 * float(row[f"{name}rmse"]) for row in own),
                    tuple(_words(row) for row in own),
                    ringed=tuple(k for k, row in enumerate(own) if row["default"]),
                    ends=tuple(
                        (100 * float(row[f"{name}low"]), 100 * float(row[f"{name}high"])) for row in own
                    ),
                    named=False,
                )
            )
        level = 100 * float(found[nothing])
        curves.append(charts.Curve("no force at all", (min(costs), max(costs)), (level, level)))
        title = f"End to end: error of {what} (rings: defaults)"
        unit = "RMSE [% of the whole force]"
        made.append(charts.Panel(title, "CPU s a frame", unit, tuple(curves), False, True, front=True))
    return made


def differences(found: Mapping[str, Any]) -> list[charts.Chart]:
    """Every pipeline against the defaults with the same model: the whole force, and the part across.

    Those that change the flow are apart: beside them the others' differences would not be seen.
    """
    colour = {model: k for k, model in enumerate(dict.fromkeys(row["model"] for row in found["rows"]))}
    usual = {row["model"]: row for row in found["rows"] if row["default"]}
    shown = []
    for part, (what, _) in _WHAT.items():
        for knobs, flows in (("law, mesh, paths", False), ("flow", True)):
            lines = []
            for row in sorted(found["rows"], key=lambda row: colour[row["model"]]):
                standard = usual[row["model"]]
                if row[f"{part}difference"] is None or (row["flow"] != standard["flow"]) != flows:
                    continue
                mean, low, high = (100 * value for value in row[f"{part}difference"])
                cost = 100 * (row["cpu_s"] / standard["cpu_s"] - 1)
                name = f"{row['model']}: {_change(row, standard)} (cost {cost:+.0f}%)"
                lines.append(charts.Row(name, mean, (low, high), colour[row["model"]]))
            title = f"Against the defaults with the same model, {knobs}: {what}"
            shown.append(charts.Chart(title, _UNIT, tuple(lines)))
    return shown


def _line(row: Mapping[str, Any]) -> dict[str, Any]:
    """One pipeline for the table."""
    cells = {name: row[name] for name in ("law", "tets", "spp", "flow", "model", "default")}
    cells |= {f"CPU s a frame{part}": f"{row[key]:.3f}" for part, key in _COSTS.items()}
    cells |= {"RMSE": _said(row, ""), "across": _said(row, "across_")}
    cells |= {"along": f"{100 * row['along_rmse']:.0f}%"}
    return cells | {
        "less the defaults'": _points(row["difference"]),
        "less the defaults', across": _points(row["across_difference"]),
    }


def verdicts(found: Mapping[str, Any]) -> list[str]:
    """Per model: which pipelines differ from the defaults beyond their paired interval, and which do not."""
    lines = []
    for usual in (row for row in found["rows"] if row["default"]):
        others = [row for row in found["rows"] if row["model"] == usual["model"] and not row["default"]]
        for name, (what, _) in _WHAT.items():
            groups: dict[str, list[str]] = {"worse": [], "better": []}
            for row in others:
                mean, low, high = row[f"{name}difference"]
                if low > 0 or high < 0:
                    cost = 100 * (row["cpu_s"] / usual["cpu_s"] - 1)
                    more = f"{_change(row, usual)} ({100 * mean:+.1f} points, cost {cost:+.0f}%)"
                    groups["worse" if low > 0 else "better"].append(more)
            told = sum(map(len, groups.values()))
            said = [f"{kind}: {', '.join(names)}" for kind, names in groups.items() if names]
            said.append(f"not told apart from them: {len(others) - told} of {len(others)}")
            level = f"{100 * usual[f'{name}rmse']:.0f}%"
            lines.append(f"{usual['model']}, {what}: {level} with the defaults; {'; '.join(said)}.")
    return lines


def _change(row: Mapping[str, Any], usual: Mapping[str, Any]) -> str:
    """In what a row differs from the defaults."""
    names = [("law", ""), ("tets", " tets"), ("spp", " spp"), ("flow", " flow")]
    return " + ".join(f"{row[key]}{unit}" for key, unit in names if row[key] != usual[key])


def _said(row: Mapping[str, Any], name: str) -> str:
    mean, low, high = (100 * float(row[f"{name}{key}"]) for key in ("rmse", "low", "high"))
    return f"{mean:.0f}% [{low:.0f}, {high:.0f}]"


def _points(found: list[float] | None) -> str:
    """Percentage points."""
    if found is None:
        return ""
    mean, low, high = (100 * value for value in found)
    return f"{mean:+.1f} [{low:+.1f}, {high:+.1f}]"


def _words(row: Mapping[str, Any]) -> str:
    return f"{row['law']} {row['tets']}, {row['spp']} spp, {row['flow']}"
