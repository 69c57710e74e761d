"""Error of the force against cost, for whole pipelines: law, mesh, paths, flow and model.

A pipeline makes sequences, recovers their flow and fits a model on them. It is tested on sequences of other
scenes that a finer pipeline made, with flow recovered by its own estimator. Its cost is the CPU time of one
frame of its data and of one estimate.

One instrument pulls or pushes. The force along the line of sight is visible in flow only through the little
that tissue spreads under a push, so that the part across the line of sight is also reported by itself.
"""

import functools
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer
from matplotlib.axes import Axes

from bench.methods.physics import GRID
from evidence import cache, datasets, report
from evidence.end_to_end import models
from evidence.intervals import difference, mean_of
from evidence.study import Study
from learn.data import clips as data
from learn.data.clips import Clip
from learn.data.grid import GridView
from synth.dataset.folder import write_whole
from synth.flow.segmentation import with_highlights
from synth.flow.track import track
from synth.job.schema import FemSection, FlowSection, Job, RenderSection

FRAMES, SIZE, VERTICES, LOAD, GESTURES = 8, (256, 192), 8000, (0.05, 0.2), ("pull", "push")
_MODELS = (models.RIDGE, models.NEAREST, models.PHYSICS)
_NO_COST = ("peak_rss_mb", "store")  # timings of a sequence that are not costs of making it
_NAME = "{law} {tets}, {spp} spp, {flow}"  # of a row's pipeline
PARTS = {"": "errors", "across_": "across"}
"""The whole force, and its part across the line of sight: prefix of a row's keys, and key of the errors."""
_ENDS = ("rmse", "low", "high")
_WHAT = {"": "the force", "across_": "the force across the line of sight"}


@dataclass(frozen=True)
class Rendering:
    """Settings by which sequences are made."""

    law: str
    tets: int
    spp: int

    def job(self, seed: int, count: int) -> Job:
        return Job.model_validate(
            {
                "seed": seed,
                "sequences": count,
                "frames": FRAMES,
                "anatomy": {"vertices": VERTICES},
                "fem": {"law": self.law, "tets": self.tets, "load": LOAD, "gestures": GESTURES},
                "render": {"size": SIZE, "spp": self.spp},
                "flow": {"backend": "ideal"},
            }
        )

    @property
    def name(self) -> str:
        return f"{self.law}-{self.tets}-{self.spp}"


def default_rendering() -> Rendering:
    """Defaults of a job at this load."""
    fem = FemSection(load=LOAD)
    return Rendering(fem.chosen_law[0], fem.tets, RenderSection().spp)


FINE = Rendering("neo-hookean", 3000, 8)  # of the sequences that all pipelines are tested on


@dataclass(frozen=True)
class Pipeline:
    """One dot of the chart."""

    rendering: Rendering
    flow: str
    model: str

    @property
    def name(self) -> str:
        return f"{self.rendering.name}, {self.flow}, {self.model}"

    @property
    def default(self) -> bool:
        """Whether rendering and flow are the defaults; a job doesn't specify the model."""
        return self.rendering == default_rendering() and self.flow == FlowSection().backend


def chosen() -> list[Pipeline]:
    """Defaults, changes of one setting at a time, all settings at their cheapest, and those of `FINE`."""
    usual, flow = default_rendering(), FlowSection().backend
    cheapest = Rendering("linear", 400, 1)
    changed = [replace(usual, law="linear"), replace(usual, tets=400), replace(usual, spp=1)]
    pairs = [(rendering, flow) for rendering in dict.fromkeys([usual, *changed, cheapest, FINE])]
    pairs += [(usual, other) for other in ("dis", "opencv-tvl1", "ideal")] + [(cheapest, "dis")]
    made = [Pipeline(rendering, flow, model) for rendering, flow in pairs for model in _MODELS]
    # Physics alone is not fitted: one dot for each flow estimator of the tested sequences.
    return [p for p in made if p.model != models.PHYSICS or (p.rendering == usual and p.flow != "ideal")]


class Sequences:
    """Sequences of one rendering on the baselines' grid, with the flow that any estimator recovers from them.

    Costs are the least CPU time a frame of all sequences: other processes only add to it, and the first
    sequence of a process includes compilation.
    """

    def __init__(self, rendering: Rendering, job: Job, work: Path) -> None:
        """Renders the sequences that are missing."""
        self._folder = datasets.folder_of(job, rendering.name, work)
        self._sequences = [datasets.render(job, index, self._folder) for index in range(job.sequences)]

    def clips(self, flow: str) -> list[Clip]:
        """Clips with the `recovered` displacement of an estimator, stored next to the sequences."""
        return [
            cache.clip(self._folder / f"clips-{flow}" / f"{k:06d}", functools.partial(self._recover, k, flow))
            for k in range(len(self._sequences))
        ]

    def data_s(self) -> float:
        """CPU time [s] of making a frame, without its flow."""
        spent: list[float] = []
        for one in self._sequences:
            times = one.attrs["timings"].items()
            spent.append(sum(t["cpu_s"] for stage, t in times if stage not in _NO_COST) / one.frames)
        return min(spent)

    def flow_s(self, flow: str) -> float:
        """CPU time [s] of a frame's masks and flow, 0 for ideal flow; requires `clips` first."""
        if flow == "ideal":
            return 0.0
        return min(float(file.read_text("utf-8")) for file in self._folder.glob(f"flow-{flow}-*.cpu_s"))

    def _recover(self, index: int, flow: str) -> Clip:
        sequence = self._sequences[index]
        clip = data.read_clip(sequence, GRID, ("ideal",))
        if flow == "ideal":
            return replace(clip, displacement=clip.displacement | {"recovered": clip.displacement["ideal"]})
        rgb, tool, tissue = (sequence[name][:] for name in ("rgb", "tool", "tissue"))
        began = time.process_time()
        found = track(flow, rgb, with_highlights(rgb, tool), tissue)
        spent = (time.process_time() - began) / (clip.frames - 1)
        write_whole(self._folder / f"flow-{flow}-{index:06d}.cpu_s", str(spent), durable=False)
        scale = float(sequence.attrs["scale_mm_per_px"])
        view = GridView(tissue, scale, GRID)
        moved = np.stack([view.mean(flow.transpose(2, 0, 1) * scale) * clip.mask for flow in found.flow])
        confidence = np.stack([view.mean(sure) * clip.mask for sure in found.confidence])
        confidence[0] = 1  # of the rest frame
        return replace(clip, displacement=clip.displacement | {"recovered": moved}, confidence=confidence)


def errors(one: Pipeline, made: Sequences, tested: Sequences, work: Path) -> dict[str, Any]:
    """Errors of a pipeline and CPU time of an estimate [s], cached in `work`.

    A pipeline fitted on ideal flow is tested with the default's flow.
    """
    fit = [] if one.model == models.PHYSICS else made.clips(one.flow)
    tests = tested.clips(FlowSection().backend if one.flow == "ideal" else one.flow)

    def compute() -> dict[str, Any]:
        estimate = models.build(one.model, fit)
        forces, spent = [], []
        for clip in tests:
            began = time.process_time()
            forces.append(estimate(clip))
            spent.append((time.process_time() - began) / clip.frames)
        return models.errors(forces, [clip.force for clip in tests]) | {"estimate_s": min(spent)}

    key = cache.key(one.name, [clip.content_hash for clip in (*fit, *tests)])
    found: dict[str, Any] = cache.result(work / "estimates", one.name.replace(", ", "-"), key, compute)
    return found


def measure(
    work: Path = Path("runs/end-to-end"), fit: int = 40, test: int = 24, seed: int = 31
) -> dict[str, Any]:
    """Error of the force against CPU time a frame, for whole pipelines.

    `work`: folder of intermediate results, from which a later run continues; `fit`: sequences that each
    pipeline makes to fit on; `test`: sequences that all are tested on.
    """
    tested, pipelines = Sequences(FINE, FINE.job(seed + 1, test), work), chosen()
    renderings = dict.fromkeys(one.rendering for one in pipelines)
    made = {one: Sequences(one, one.job(seed, fit), work) for one in renderings}
    rows: list[dict[str, Any]] = []
    for one in pipelines:
        row = asdict(one.rendering) | {"flow": one.flow, "model": one.model, "default": one.default}
        row |= errors(one, made[one.rendering], tested, work)
        flow_s = made[default_rendering()].flow_s(one.flow)
        costs = {"data_s": made[one.rendering].data_s(), "flow_s": flow_s}
        rows.append(row | costs | {"cpu_s": sum(costs.values()) + row["estimate_s"]})
        done = f"{len(rows)} of {len(pipelines)}: {one.name}, {100 * np.mean(row['errors']):.0f}%"
        typer.echo(done, err=True)
    true = [clip.force for clip in tested.clips("ideal")]
    nothing = models.errors([0 * force for force in true], true)
    return {
        "tested": asdict(FINE) | {"size": SIZE, "frames": FRAMES, "sequences": test},
        "seed": seed,
        "zero": float(np.mean(nothing["errors"])),
        "across_zero": float(np.mean(nothing["across"])),
        "rows": summarised(rows, seed),
    }


def summarised(rows: list[dict[str, Any]], seed: int) -> list[dict[str, Any]]:
    """Rows with mean errors and their difference from the default pipeline with the same model.

    `rmse`, `low`, `high` of the whole force, and of its part across as `across_rmse` and so on, BCa;
    `difference` and `across_difference`: mean, low, high; None for a default.
    """
    defaults = {row["model"]: row for row in rows if row["default"]}
    done = []
    for row in rows:
        usual = None if row["default"] else defaults[row["model"]]
        more: dict[str, Any] = {"along_rmse": float(np.mean(row["along"]))}
        for name, part in PARTS.items():
            keys = (f"{name}{end}" for end in _ENDS)
            more |= zip(keys, mean_of(row[part], seed), strict=True)
            more[f"{name}difference"] = None if usual is None else difference(usual[part], row[part], seed)
        done.append(row | more)
    return done


def page(found: Mapping[str, Any]) -> report.Page:
    """Error against cost, and a table of the ridge pipelines, cheapest first."""
    rows = sorted(found["rows"], key=lambda row: float(row["cpu_s"]))
    ridge = [row for row in rows if row["model"] == models.RIDGE]
    flow = next(row["flow"] for row in ridge if row["default"])
    found_flow = [row for row in ridge if row["flow"] != "ideal"]
    off = [
        [100 * r["across_rmse"] for r in found_flow if (r["flow"] == flow) == own] for own in (True, False)
    ]
    least, most = [min(some) for some in off], [max(some) for some in off]
    return report.Page(
        "Which part of a whole pipeline pays?",
        found,
        (
            f"**Across the line of sight the error of ridge is {least[0]:.0f} to {most[0]:.0f}% with flow by "
            f"{flow}, for every law, mesh and number of paths, and {least[1]:.0f} to {most[1]:.0f}% with "
            "other flow estimators.**",
            "Root mean square error relative to that of the force, mean over sequences with BCa intervals; "
            "*difference*: from the defaults, paired. Other models are in the data. Zero force has an error "
            f"of {100 * found['zero']:.0f}%, across the line of sight of {100 * found['across_zero']:.0f}%. "
            "CPU time: least measured for a frame of data, its flow and an estimate.",
        ),
        [report.Section("", [_cells(row) for row in ridge])],
        report.chart(*(functools.partial(_draw, found=found, part=part) for part in PARTS)),
    )


def _draw(axes: Axes, found: Mapping[str, Any], part: str) -> None:
    """A dot with its interval for each pipeline, and the error of zero force."""
    rows = [row | {"error": 100 * row[f"{part}rmse"]} for row in found["rows"]]
    groups = {model: own for (model,), own in report.grouped(rows, "model").items()}
    for row in rows:
        ends = (100 * row[f"{part}{end}"] for end in ("low", "high"))
        axes.vlines(row["cpu_s"], *ends, color="#c9ced6", zorder=0)
    report.scatter(axes, groups, "cpu_s", "error")
    axes.axhline(100 * found[f"{part}zero"], linestyle=":", color="#3b3f46", label="zero force")
    axes.set(title=f"Error of {_WHAT[part]} (rings: defaults)", xlabel="CPU s a frame")
    report.set_log(axes, "y")
    axes.set_ylabel("RMSE [% of the whole force]")
    report.legend(axes)


def _cells(row: Mapping[str, Any]) -> dict[str, Any]:
    more = row["across_difference"]
    return {
        "pipeline": _NAME.format_map(row),
        "model": row["model"],
        "CPU s": f"{row['cpu_s']:.3f}",
        "error [%]": report.mean_cell([row[key] for key in _ENDS], ".0f", 100),
        "across [%]": report.mean_cell([row[f"across_{key}"] for key in _ENDS], ".0f", 100),
        "difference across": None if more is None else report.mean_cell(more, "+.1f", 100),
    }


STUDY = Study(
    measure,
    "end-to-end/pareto.json",
    page,
    ("--work {work}/end-to-end",),
    needs=("mesh", "mechanics", "picture", "truth", "flow", "stereo", "network", "score-stereo"),
    timed=True,
)
