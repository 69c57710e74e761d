"""What each folder of results shows, drawn from its data alone: `bench pages` writes and checks it.

Rooms whose own command draws points against cost or trouble (`pareto`, `stability`, tuning) are not here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bench.output import forest_plot, plot
from bench.output.result_page import Chart, Sheet, bars, flat
from bench.scoring import pool
from evidence.defaults_on_front import read
from evidence.gap import experiment, leakage
from evidence.learn import run_table, summary

Tree = Mapping[str, Any]


def every(results: Path) -> Iterator[tuple[Path, Sheet]]:
    """The folders that have data, each with its sheet.

    Raises:
        UserError: data that cannot be read.
    """
    for name, (file, draw) in _FILES.items():
        if (results / name / file).is_file():
            yield results / name, draw(read(results / name / file))
    for name, gather in _FOLDERS.items():
        if any((results / name).rglob("*.json")):
            yield results / name, gather(results / name)
    for runs in sorted(results.glob("learn/*/runs.json")):
        yield runs.parent, learning(runs.parent)


def inverse(found: Tree) -> Sheet:
    """Error by method, a picture a law of the tissue."""
    charts = [
        Chart(
            f"{law} tissue: error of the force's size, 90% within the bar",
            "mN",
            tuple(
                forest_plot.Row(name, m["size_mae_mn"], (m["size_mae_mn"], m["size_p90_mn"]))
                for name, m in one["methods"].items()
            ),
        )
        for law, one in found["tissue"].items()
    ]
    tables = [
        (f"{law} tissue", [{"method": name} | m for name, m in one["methods"].items()])
        for law, one in found["tissue"].items()
    ]
    return Sheet("Force by physics alone", "bench experiment inverse", found, tuple(charts), tuple(tables))


def scoring(found: Tree) -> Sheet:
    """Time by stage."""
    stages = {name: t["wall_s"] for name, t in found["timings"].items() if isinstance(t, Mapping)}
    title = (
        f"{found['seconds']:g} s of {found['size'][0]} x {found['size'][1]}: {found['wall_s']:.0f} s in all"
    )
    timed = [{"stage": n} | dict(t) for n, t in found["timings"].items() if isinstance(t, Mapping)]
    return Sheet(
        "What scoring costs",
        found["command"],
        found,
        (Chart(title, "wall s by stage, two processes side by side", bars(stages)),),
        (("Stages", timed),),
    )


def stages(found: Tree) -> Sheet:
    """CPU time a frame by stage, up to the largest of a sequence."""
    costs = found["cpu_s_a_frame"]
    ends = {name: (c["median"], c["largest"]) for name, c in costs.items()}
    rows = bars({name: c["median"] for name, c in costs.items()}, ends)
    return Sheet(
        "The whole way, by stage",
        "bench experiment stages runs/demo/data -o docs/results/pipeline/stages",
        found,
        (Chart("Median over sequences; the bar ends at the largest", "CPU s a frame", rows),),
        (("In all", flat(found)),),
    )


def flow(found: Tree) -> Sheet:
    """Every figure asked, as a part of what was allowed."""
    rows = [row for part in found.values() if "rows" in part for row in part["rows"]]
    charts = []
    for on in dict.fromkeys(row["on"] for row in rows if row["asked"]):
        shares = {
            row["what"]: (
                row["asked"] / row["measured"] if row["at_least"] else row["measured"] / row["asked"]
            )
            for row in rows
            if row["on"] == on and row["asked"]
        }
        charts.append(Chart(f"{on}: reached where at most 1", "measured / asked", bars(shares)))
    commands = "; ".join(part["command"] for part in found.values() if "command" in part)
    return Sheet("Flow: asked against measured", commands, found, tuple(charts), (("Figures", rows),))


def live(found: Tree) -> Sheet:
    """Latency of a live stream."""
    kept = {k: found[k] for k in ("p50_ms", "p95_ms", "p99_ms", "mask_ms") if k in found}
    rows = bars(kept)
    return Sheet(
        "Flow on a live stream",
        found["command"],
        found,
        (Chart("Latency", "ms", rows),),
        (("All", flat(found)),),
    )


def cycles(found: Tree) -> Sheet:
    """Noise against cost, ours and Cycles'."""
    curves = tuple(
        plot.Curve(
            name,
            tuple(row["cpu_s"] for row in found["rows"] if row["renderer"] == name),
            tuple(row["noise"] for row in found["rows"] if row["renderer"] == name),
            tuple(f"{row['spp']} spp" for row in found["rows"] if row["renderer"] == name),
        )
        for name in dict.fromkeys(row["renderer"] for row in found["rows"])
    )
    panel = plot.Panel("The same scene in both", "CPU s a picture", "noise / mean", curves, True, True)
    command = "bench experiment cycles --python PY --spp 2 --spp 4 --spp 16"
    return Sheet("Against Cycles", command, found, (panel,), (("Pictures", found["rows"]),))


def realism(found: Tree) -> Sheet:
    """Statistics of renders in units of the photograph's spread."""
    rows = []
    for one in found["statistics"]:
        (low, middle, high), (a, b, c) = one["photograph"], one["rendered"]
        wide = max(high - low, 1e-12)
        rows.append(
            forest_plot.Row(one["statistic"], (b - middle) / wide, ((a - middle) / wide, (c - middle) / wide))
        )
    unit = "quantiles of renders less the photograph's median, over its own spread"
    return Sheet(
        "Against a photograph",
        "bench experiment realism PHOTO",
        found,
        (Chart("Within half a unit or so: as the photograph's own crops differ", unit, tuple(rows)),),
        (("Statistics", [{k: str(v) for k, v in one.items()} for one in found["statistics"]]),),
    )


def loading(found: Tree) -> Sheet:
    """Time of a training step."""
    rows = bars({row["way"]: row["frames/s"] for row in found["rows"]})
    chart = Chart("Training on one thread", "frames a second", rows)
    return Sheet(
        "Training throughput", "bench experiment loading", found, (chart,), (("Ways", found["rows"]),)
    )


def render_cost(folder: Path) -> Sheet:
    """Memory over time, and every other figure in a table."""
    found = {file.stem: read(file) for file in sorted(folder.glob("*.json"))}
    curves = []
    for name, words in (("frames", "frames of one scene"), ("scenes", "scenes")):
        if name in found:
            memory, count = found[name]["every_tenth_mb"], found[name]["count"]
            so_far = tuple(float(k + 1) * count / len(memory) for k in range(len(memory)))
            curves.append(plot.Curve(words, so_far, tuple(memory)))
    panel = plot.Panel("Memory of one process", "frames or scenes so far", "MB", tuple(curves), log_x=True)
    tables = tuple((name, flat(one)) for name, one in found.items())
    command = "bench experiment render cost first truth bytes frames scenes"
    return Sheet("Rendering: cost, truth, memory", command, {"machine": _machine(found)}, (panel,), tables)


def engine(folder: Path) -> Sheet:
    """Every trial's figures as a part of what was allowed, and all of them in tables."""
    found = {file.parent.name: read(file) for file in sorted(folder.glob("*/*.json"))}
    shares = {words: share(found[name]) for name, words, share in _ENGINE if name in found}
    chart = Chart("Reached where at most 1", "found / allowed", bars(shares))
    tables = tuple((name, flat(one)) for name, one in found.items())
    return Sheet("Engine", "; ".join(_ENGINE_COMMANDS), {"machine": _machine(found)}, (chart,), tables)


def learning(folder: Path) -> Sheet:
    """What every loss, network and control comes to, over the tested sequences."""
    found = [run for run in run_table.read(folder) if not run["control"]]
    charts = []
    for key, words in summary.COLUMNS:
        rows = [
            forest_plot.Row(f"{name} ({seeds})", value.mean, (value.low, value.high))
            for name, seeds, value in summary.families(found, key)
        ]
        charts.append(
            Chart(words, "mean over tested sequences, BCa interval; in brackets: runs", tuple(rows))
        )
    command = " ".join(["bench experiment learn --cache CACHE", *_LEARNING.get(folder.name, ())])
    return Sheet(f"Learning: {folder.name}", command, {}, tuple(charts))


def learn_stability(folder: Path) -> Sheet:
    """How much R² of the map each disturbance leaves."""
    found = {file.stem: read(file) for file in sorted(folder.glob("*.json"))}
    charts = []
    for name, one in found.items():
        rows = [row for row in one["rows"] if row.get("map R²") is not None]
        if rows:
            values = {", ".join(str(row[k]) for k in _SAID if k in row): row["map R²"] for row in rows}
            charts.append(Chart(f"{name}: R² of the map", "pooled over tested sequences", bars(values)))
    tables = tuple((name, one["rows"]) for name, one in found.items())
    machine = {"machine": _machine(found)}
    return Sheet(
        "Learning: where it breaks", "bench stability learn --cache CACHE", machine, tuple(charts), tables
    )


def surface(folder: Path) -> Sheet:
    """Volume kept and error by size of mesh, a real surface each."""
    found = {file.stem: read(file) for file in sorted(folder.glob("*.json"))}
    panels = [
        plot.Panel(
            words,
            "tetrahedra",
            unit,
            tuple(
                plot.Curve(
                    name, tuple(r["tets"] for r in one["rows"]), tuple(100 * r[key] for r in one["rows"])
                )
                for name, one in found.items()
            ),
        )
        for key, words, unit in (
            ("error", "Displacement of the opening against the finest mesh", "%"),
            ("volume_kept", "Volume kept", "%"),
        )
    ]
    tables = tuple((name, one["rows"]) for name, one in found.items())
    commands = "; ".join(one["command"] for one in found.values())
    return Sheet("Real surfaces", commands, {"machine": _machine(found)}, tuple(panels), tables)


def _machine(found: Mapping[str, Tree]) -> dict[str, str]:
    """What the files say; where they differ, all of it."""
    all_ = [one["machine"] for one in found.values() if "machine" in one]
    names = dict.fromkeys(name for one in all_ for name in one)
    return {n: " / ".join(dict.fromkeys(str(one[n]) for one in all_ if n in one)) for n in names}


_LEARNING = {
    "presets": ("--presets",),
    "fine": ("--fine",),
    "recovered": ("--rendered", "DATASET"),
}
"""Folder of learn's results -> what else its command says."""
_SAID = ("trained with", "contacts", "gesture", "shown", "trained", "confidence", "s")
"""What names a row of learn's stability."""
_ENGINE_COMMANDS = (
    "bench pareto engine",
    "bench pareto reading DATASET",
    "bench experiment cost DATASET",
    "bench experiment scale",
    "bench stability kills",
    "bench stability trouble --cpu-s 2",
    "bench stability damage DATASET",
    "bench stability dask",
    "bench stability faults",
)
_ENGINE: tuple[tuple[str, str, Callable[[Tree], float]], ...] = (
    ("speed", "two workers, 1.8 times one", lambda f: 1.8 / f["workers"]["ratio"]),
    ("speed", "engine and store, 8% over stages", lambda f: f["overhead"]["overhead"] / 0.08),
    ("trouble", "30 scenes with trouble, 1.2 times", lambda f: f["ratio"] / 1.2),
    ("scale", "status of 100,000 sequences, 5 s", lambda f: f["status"]["wall_s"] / 5),
    ("scale", "report of 100,000 sequences, 5 s", lambda f: f["report"]["wall_s"] / 5),
    ("scale", "memory for it, 1 GB", lambda f: f["report"]["peak_mb"] / 1000),
    ("reading", "a random frame, 20 ms", lambda f: f["sets"][1]["ours"]["median_ms"] / 20),
)
_FILES: Mapping[str, tuple[str, Callable[[Tree], Sheet]]] = {
    "exvivo": ("pool.json", pool.drawn),
    "gap": ("results.json", experiment.drawn),
    "inverse": ("results.json", inverse),
    "leakage": ("results.json", leakage.drawn),
    "scoring": ("results.json", scoring),
    "pipeline": ("stages/stages.json", stages),
    "flow/benchmark": ("results.json", flow),
    "flow/live": ("live.json", live),
    "render/cycles": ("cycles.json", cycles),
    "render/realism": ("realism.json", realism),
    "learn/loading": ("data-cpu.json", loading),
}
_FOLDERS: Mapping[str, Callable[[Path], Sheet]] = {
    "render/cost": render_cost,
    "engine": engine,
    "fem/surface": surface,
    "learn/stability": learn_stability,
}
