"""What each folder of results shows, drawn from its data alone: `bench pages` writes and checks it.

Only the pages of all rooms together are not here (`evidence.overview`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from bench.output import charts, result_page
from bench.output.charts import Chart, bars
from bench.output.result_page import Page, Section
from bench.scoring import pool
from evidence.defaults_on_front import read
from evidence.learn import preset_errors, run_table, summary

Tree = Mapping[str, Any]


def stale(folder: Path) -> list[Path]:
    """Files under a folder of results that are not what their data say."""
    return [place / name for place, page in every(folder) for name in result_page.stale(page, place)]


def write(folder: Path) -> list[Path]:
    """Writes them; gives back those that changed."""
    return [place / name for place, page in every(folder) for name in result_page.write(page, place)]


def every(results: Path) -> Iterator[tuple[Path, Page]]:
    """The folders that have data, each with its page.

    Raises:
        UserError: data that cannot be read.
    """
    for name, (file, drawn) in _FILES.items():
        if (results / name / file).is_file():
            # A room's module is loaded where it has data: some of them load a renderer.
            draw = drawn if callable(drawn) else import_module(f"evidence.{drawn}").drawn
            yield results / name, draw(read(results / name / file))
    for name, gather in _FOLDERS.items():
        if any((results / name).rglob("*.json")):
            draw = gather if callable(gather) else import_module(f"evidence.{gather}").drawn
            yield results / name, draw(results / name)
    for runs in sorted(results.glob("learn/*/runs.json")):
        yield runs.parent, learning(runs.parent)


def stages(found: Tree) -> Page:
    """CPU time a frame by stage, up to the largest of a sequence."""
    costs = found["cpu_s_a_frame"]
    ends = {name: (c["median"], c["largest"]) for name, c in costs.items()}
    rows = bars({name: c["median"] for name, c in costs.items()}, ends)
    chart = Chart("Median over sequences; the bar ends at the largest", "CPU time a frame [s]", rows)
    return Page(
        "The whole way, by stage",
        found,
        [chart],
        [Section("In all", flat(found))],
        command="bench experiment stages runs/demo/data -o docs/results/pipeline/stages",
        name=_BESIDE,
    )


def live(found: Tree) -> Page:
    """Latency of a live stream."""
    shown = bars({k: found[k] for k in ("p50_ms", "p95_ms", "p99_ms", "mask_ms") if k in found})
    chart = Chart("Latency", "ms", shown)
    return Page("Flow on a live stream", found, [chart], [Section("All", flat(found))])


def cycles(found: Tree) -> Page:
    """Noise against cost, ours and Cycles'."""
    curves = []
    for name in dict.fromkeys(row["renderer"] for row in found["rows"]):
        own = [row for row in found["rows"] if row["renderer"] == name]
        x, y = (tuple(row[key] for row in own) for key in ("cpu_s", "noise"))
        curves.append(charts.Curve(name, x, y, tuple(f"{row['spp']} spp" for row in own)))
    unit = "CPU time a picture [s]"
    panel = charts.Panel("The same scene in both", unit, "noise / mean", tuple(curves), True, True)
    command = "bench experiment cycles --python PY --spp 2 --spp 4 --spp 16"
    return Page("Against Cycles", found, [panel], [Section("Pictures", found["rows"])], command=command)


def realism(found: Tree) -> Page:
    """Statistics of renders in units of the photograph's spread."""
    shown = []
    for one in found["statistics"]:
        (low, middle, high), rendered = one["photograph"], one["rendered"]
        a, b, c = ((value - middle) / max(high - low, 1e-12) for value in rendered)
        shown.append(charts.Row(one["statistic"], b, (a, c)))
    unit = "quantiles of renders less the photograph's median, over its own spread"
    title = "Within half a unit or so: as the photograph's own crops differ"
    return Page(
        "Against a photograph",
        found,
        [Chart(title, unit, tuple(shown))],
        [Section("Statistics", found["statistics"])],
        command="bench experiment realism PHOTO",
    )


def render_cost(folder: Path) -> Page:
    """Memory over time, and every other figure in a table."""
    found = {file.stem: read(file) for file in sorted(folder.glob("*.json"))}
    curves = []
    for name, words in (("frames", "frames of one scene"), ("scenes", "scenes")):
        if name in found:
            memory, count = found[name]["every_tenth_mb"], found[name]["count"]
            so_far = tuple(float(k + 1) * count / len(memory) for k in range(len(memory)))
            curves.append(charts.Curve(words, so_far, tuple(memory)))
    panel = charts.Panel(
        "Memory of one process", "frames or scenes so far", "memory [MB]", tuple(curves), log_x=True
    )
    tables = [Section(name, flat(one)) for name, one in found.items()]
    command = "bench experiment render cost first truth bytes frames scenes"
    return Page(
        "Rendering: cost, truth, memory", {"machine": _machine(found)}, [panel], tables, command=command
    )


def engine(folder: Path) -> Page:
    """Every trial's figures as a part of what was allowed, and all of them in tables."""
    found = {file.parent.name: read(file) for file in sorted(folder.glob("*/*.json"))}
    shares = {words: share(found[name]) for name, words, share in _ENGINE if name in found}
    chart = Chart("Reached where at most 1", "found / allowed", bars(shares))
    return Page(
        "Engine: every trial's figures",
        {"machine": _machine(found)},
        [chart],
        [Section(name, flat(one)) for name, one in found.items()],
        command="; ".join(_ENGINE_COMMANDS),
        name=_BESIDE,
    )


def learning(folder: Path) -> Page:
    """What every loss, network and control comes to, over the tested sequences."""
    found = [run for run in run_table.read(folder) if not run["control"]]
    shown: list[Chart] = []
    table: dict[str, dict[str, Any]] = {}
    for key, words in summary.COLUMNS:
        rows = []
        for name, seeds, value in summary.families(found, key):
            said = f"{name} ({seeds})"
            rows.append(charts.Row(said, value.mean, (value.low, value.high)))
            text = f"{value.mean:.4g} [{value.low:.4g}, {value.high:.4g}]"
            table.setdefault(said, {"runs": said})[words] = text
        unit = "mean over tested sequences, BCa interval; in brackets: runs"
        shown.append(Chart(words, unit, tuple(rows)))
    command = " ".join(["bench experiment learn --cache CACHE", *_LEARNING.get(folder.name, ())])
    tables = [Section("All figures", list(table.values()))]
    return Page(f"Learning: {folder.name}", {}, shown, tables, command=command)


def learn_pareto(folder: Path) -> Page:
    """Errors are of the runs beside it."""
    from evidence.learn import pareto

    return pareto.drawn(folder, preset_errors.errors(folder.parent))


def surface(folder: Path) -> Page:
    """Volume kept and error by size of mesh, a real surface each."""
    found = {file.stem: read(file) for file in sorted(folder.glob("*.json"))}
    panels = []
    for key, words in (
        ("error", "Displacement of the opening against the finest mesh"),
        ("volume_kept", "Volume kept"),
    ):
        curves = []
        for name, one in found.items():
            sizes = tuple(row["tets"] for row in one["rows"])
            curves.append(charts.Curve(name, sizes, tuple(100 * row[key] for row in one["rows"])))
        panels.append(charts.Panel(words, "tetrahedra", "%", tuple(curves)))
    tables = [Section(name, one["rows"]) for name, one in found.items()]
    commands = "; ".join(one["command"] for one in found.values())
    return Page("Real surfaces", {"machine": _machine(found)}, panels, tables, command=commands)


def flat(tree: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What a result says in single values, as rows of two columns; lists and the machine are left out."""
    rows: list[dict[str, Any]] = []

    def walk(node: Mapping[str, Any], before: str) -> None:
        for key, value in node.items():
            if isinstance(value, Mapping) and key != "machine":
                walk(value, f"{before}{key}: ")
            elif not isinstance(value, (list, Mapping)):
                rows.append({"what": f"{before}{key}", "value": value})

    walk(tree, "")
    return rows


def _machine(found: Mapping[str, Tree]) -> dict[str, str]:
    """What the files say; where they differ, all of it."""
    all_ = [one["machine"] for one in found.values() if "machine" in one]
    names = dict.fromkeys(name for one in all_ for name in one)
    return {n: " / ".join(dict.fromkeys(str(one[n]) for one in all_ if n in one)) for n in names}


_LEARNING = {
    "presets": ("--presets",),
    "fine": ("--fine",),
    "large": ("--large",),
    "recovered": ("--rendered", "DATASET"),
}
"""Folder of learn's results -> what else its command says."""
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
_BESIDE = "figures.html"
"""Where a README stands, which the site shows as the folder's page."""
_FILES: Mapping[str, tuple[str, str | Callable[[Tree], Page]]] = {
    "exvivo/one-eye": ("pool.json", lambda found: pool.drawn(found, "README.md")),
    "exvivo/two-eyes": ("pool.json", lambda found: pool.drawn(found, "README.md")),
    "gap": ("results.json", "gap.experiment"),
    "inverse": ("results.json", "scoring.inverse"),
    "pulse": ("results.json", "scoring.pulse"),
    "leakage": ("results.json", "gap.leakage"),
    "learn/curves": ("curves.json", "curves.page"),
    "learn/shipped": ("shipped.json", "learn.shipped"),
    "learn/foreign/one-eye": ("pool.json", lambda found: pool.drawn(found, "README.md")),
    "learn/foreign/two-eyes": ("pool.json", lambda found: pool.drawn(found, "README.md")),
    "scoring": ("results.json", "scoring.scoring_cost"),
    "mechanics": ("results.json", "mechanics.page"),
    "pipeline": ("stages/stages.json", stages),
    "end-to-end": ("pareto.json", "end_to_end.page"),
    "fem/pareto": ("pareto.json", "fem.pareto"),
    "fem/stability": ("stability.json", "fem.stability"),
    "flow/benchmark": ("results.json", "flow.experiment"),
    "flow/look": ("look.json", "flow.look"),
    "flow/live": ("live.json", live),
    "flow/pareto": ("pareto.json", "flow.pareto"),
    "flow/recordings": ("recordings.json", "flow.foreign"),
    "flow/stability": ("stability.json", "flow.stability"),
    "flow/second-eye": ("second-eye.json", "end_to_end.second_eye"),
    "flow/stereo": ("stereo.json", "flow.stereo"),
    "flow/stereo-stability": ("stability.json", "flow.stereo_stability"),
    "render/cycles": ("cycles.json", cycles),
    "render/pareto": ("pareto.json", "render.pareto"),
    "fem/relief": ("relief.json", "fem.relief"),
    "fem/slides": ("slides.json", "fem.slides"),
    "fem/half-space": ("half-space.json", "fem.half_space"),
    "fem/contact": ("contact.json", "fem.contact"),
    "render/realism": ("realism.json", realism),
    "render/stability": ("stability.json", "render.stability"),
}
"""Folder -> its data, and what draws them: a function here, or the module that has `drawn`."""
_FOLDERS: Mapping[str, str | Callable[[Path], Page]] = {
    "render/cost": render_cost,
    "engine": engine,
    "fem/surface": surface,
    "render/look": "look.page",
    "learn/loading": "learn.throughput",
    "learn/pareto": learn_pareto,
    "learn/stability": "learn.stability",
    "tune": "tune.experiment",
}
