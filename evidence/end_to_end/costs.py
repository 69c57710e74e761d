"""What a frame and an answer cost in `bench pareto end-to-end`: everything in turn, in one warm process.

Costs are not those of making the data, which may have taken hours beside other work. Every round renders the
same sequence in every world, recovers its flow with every estimator and asks every model; the least of the
rounds counts, for what else runs on a machine only ever adds. What one machine does slowly it so does slowly
for all.
"""

from __future__ import annotations

import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.methods.baselines import GRID
from evidence.end_to_end.models import Answer
from evidence.gap.recompute_flow import recover_flow
from learn.data import clips as data
from learn.data.clips import Clip
from synth.dataset import location
from synth.dataset.store import Sequence as Stored
from synth.dataset.store import open_sequence
from synth.flow import mask
from synth.job.schema import Job
from synth.sequence import pipeline


@dataclass(frozen=True)
class Costs:
    """Least CPU time [s] of the rounds, by name."""

    data: dict[str, float]
    """A frame of data of every world, without flow."""
    flow: dict[str, float]
    """A frame followed by every estimator, masks included; `ideal` is free."""
    answer: dict[str, float]
    """A frame's answer of every model."""
    rounds: dict[str, list[float]]
    """All that was measured, by `data NAME`, `flow NAME` and `answer NAME`."""


def measure(
    jobs: Mapping[str, Job],
    flows: Sequence[str],
    answers: Mapping[str, Answer],
    clips: Sequence[Clip],
    work: Path,
    rounds: int,
    report: Callable[[str], None] = lambda line: None,
) -> Costs:
    """Times everything `rounds` times in turn.

    Args:
        jobs: every world's job; the first one's sequences are followed.
        flows: estimators.
        answers: models, fitted.
        clips: what they are asked about; one a round, and once more if there are fewer.
        work: existing folder for the sequences, which are removed.
        rounds: one sequence of every world each; at least two, for estimators and models are cold in the
            first.
        report: told of every round.
    """
    found: defaultdict[str, list[float]] = defaultdict(list)
    for job in jobs.values():  # compiles; flow and models are warm after the first of the rounds
        _rendered(job.model_copy(update={"frames": 2}), 0, work / "warm")
    for k in range(rounds):
        followed: Stored | None = None
        for name, job in jobs.items():
            made = _rendered(job, k % job.sequences, work / "timed" / name)
            found[f"data {name}"].append(_cpu_s(made) / job.frames)
            followed = followed or made
        assert followed is not None
        _time_flows(followed, next(iter(jobs.values())), flows, found)
        clip = clips[k % len(clips)]
        for name, answer in answers.items():
            began = time.process_time()
            answer(clip)
            found[f"answer {name}"].append((time.process_time() - began) / clip.frames)
        report(f"round {k + 1} of {rounds}")
    for folder in ("warm", "timed"):
        shutil.rmtree(work / folder, ignore_errors=True)
    return least(found)


def least(found: Mapping[str, Sequence[float]]) -> Costs:
    """The least of every list, sorted into data, flow and answers by the first word of its name."""
    kinds: dict[str, dict[str, float]] = {"data": {}, "flow": {"ideal": 0.0}, "answer": {}}
    for key, values in found.items():
        kind, name = key.split(" ", 1)
        kinds[kind][name] = min(values)
    return Costs(**kinds, rounds={key: list(values) for key, values in found.items()})


def _rendered(job: Job, index: int, folder: Path) -> Stored:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pipeline.render_sequence(job, index, folder, lambda stage, done, of: None)
    return open_sequence(location.store(folder, index))


def _cpu_s(made: Stored) -> float:
    """CPU time of a sequence, all but its writing."""
    times = made.attrs["timings"]
    return float(sum(t["cpu_s"] for name, t in times.items() if name not in ("peak_rss_mb", "store")))


def _time_flows(made: Stored, job: Job, flows: Sequence[str], found: defaultdict[str, list[float]]) -> None:
    clip = data.read_clip(made, GRID, ("ideal",))
    rgb, tools = made["rgb"][...], made["tool"][...].astype(bool)
    for flow in flows:
        began = time.process_time()
        hidden = mask.hidden(rgb, tools)
        masks_s = time.process_time() - began
        estimator = pipeline.estimator(job.flow.model_copy(update={"backend": flow}))
        _, flow_s = recover_flow(made, clip, estimator, hidden, GRID)
        found[f"flow {flow}"].append((masks_s + flow_s) / (clip.frames - 1))
