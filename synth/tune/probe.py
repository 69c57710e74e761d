"""One sequence of a job, computed at full fidelity then with knobs turned: error of the force, and cost."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.fem import tool
from synth.fem.solver import Deformation
from synth.flow import mask
from synth.flow.track import Tracker
from synth.job.schema import Job
from synth.render import truth
from synth.render.anatomy.surface import Surface
from synth.render.camera import camera as cameras
from synth.render.scene import Shot, Studio
from synth.sequence import pipeline, scenario
from synth.sequence.timeline import Timeline
from synth.system.stopwatch import Stopwatch
from synth.tune import force_reading

Floats = NDArray[np.float64]

LOADED = 3
"""Frames with load that are looked at in a sequence, on the way up to its peak."""


@dataclass(frozen=True)
class Measured:
    """What a setting does to one sequence."""

    label: Floats
    """(K, I) error of the force that the true displacement stands for, as a part of the force."""
    seen: Floats | None
    """(K, I) the same of the recovered displacement; None: no picture was made."""
    cost: dict[str, float]
    """CPU-s by stage: `physics`, `scene` a sequence; `render`, `flow` a frame."""


@dataclass(frozen=True)
class _Film:
    rgb: NDArray[np.uint8]
    blocked: NDArray[np.bool_]
    shots: list[Shot]
    studio: Studio
    cost: dict[str, float]


class Probe:
    """One sequence. What `measure` was asked before is partly remembered."""

    def __init__(self, job: Job, index: int) -> None:
        """Computes the sequence at full fidelity.

        Args:
            job: with every knob at its finest.
            index: which sequence.

        Raises:
            UserError: the sequence cannot be carried out.
        """
        self._job, self._index = job, index
        case = scenario.draw(job, index)
        self._frames = loaded(job, index)
        self._motions: dict[str, tuple[Surface, Deformation, float]] = {}
        self._film: tuple[str, _Film] | None = None
        surface, motion, _ = self._moved(job)
        film = self._filmed(job)
        still, lens = film.studio.still, film.studio.camera
        self._still, self._lens = still, lens
        true = np.stack([force_reading.cells(shot.flow, still.tissue) for shot in film.shots[1:]])
        self._reading = force_reading.fit_reading(
            job,
            case,
            surface,
            motion,
            self._frames[1:],
            still,
            lens,
            lens.mm_per_px * true,
            np.stack([force_reading.shown(shot.visible, still.tissue) for shot in film.shots[1:]]),
        )

    def measure(self, job: Job, pictures: bool = True) -> Measured:
        """What the sequence is with knobs turned.

        Args:
            job: the setting.
            pictures: whether frames are rendered and followed; without them the surface must be that of
                full fidelity.

        Raises:
            UserError: the setting cannot carry the sequence out.
        """
        surface, motion, spent = self._moved(job)
        if not pictures:
            rest = cameras.project(self._lens, surface.vertices)
            flows = [
                truth.at_rest_pixels(
                    self._still,
                    surface.faces,
                    cameras.project(self._lens, surface.vertices + motion.displacement[f]) - rest,
                )
                for f in self._frames[1:]
            ]
            return Measured(
                self._error(flows, self._still.tissue, self._lens.mm_per_px), None, {"physics": spent}
            )
        film = self._filmed(job)
        still, scale = film.studio.still, film.studio.camera.mm_per_px
        label = self._error([shot.flow for shot in film.shots[1:]], still.tissue, scale)
        if job.flow.backend == "ideal":
            return Measured(label, None, {"physics": spent, **film.cost})
        tracker = Tracker(pipeline.estimator(job.flow), film.rgb[0], film.blocked[0], still.tissue)
        flows, each = [], []
        for frame, blocked in zip(film.rgb[1:], film.blocked[1:], strict=True):
            with _timed() as cpu:
                flows.append(tracker.step(frame, blocked)[0])
            each.append(cpu[0])
        # All frames but the first start from the one before.
        cost = {"physics": spent, **film.cost, "flow": min(each[1:] or each)}
        return Measured(label, self._error(flows, still.tissue, scale), cost)

    def rest(self) -> None:
        """Lets go of pictures until they are asked for again."""
        self._film = None

    def _error(self, flows: list[Any], tissue: NDArray[np.bool_], scale: float) -> Floats:
        moved = scale * np.stack([force_reading.cells(flow, tissue) for flow in flows])
        return self._reading.error(moved)

    def _moved(self, job: Job) -> tuple[Surface, Deformation, float]:
        key = job.fem.model_dump_json() + job.anatomy.model_dump_json()
        if key not in self._motions:
            case = scenario.draw(job, self._index)
            with _timed() as cpu:
                surface, tets = pipeline.build(job, case)
                motion = pipeline.move(job, case, surface, tets)
            if len(self._motions) > 1:  # full fidelity and the latest
                del self._motions[list(self._motions)[1]]
            self._motions[key] = (surface, motion, cpu[0])
        return self._motions[key]

    def _filmed(self, job: Job) -> _Film:
        key = job.model_dump_json(exclude={"flow"})
        if self._film is None or self._film[0] != key:
            self._film = None  # of two studios the first forgets its scene
            self._film = (key, self._filming(job))
        return self._film[1]

    def _filming(self, job: Job) -> _Film:
        surface, motion, _ = self._moved(job)
        case = scenario.draw(job, self._index)
        lens = cameras.place(case.view, job.render)
        with _timed() as scene:
            studio = Studio(surface, case.look, lens, job, [gesture.kind for gesture in case.gestures])
        line = Timeline(motion, lens, case.sway, case.look.light, job.fps)
        seeds = scenario.frame_seeds(job, self._index)
        shots, each = [], []
        for f in self._frames:
            with _timed() as cpu:
                opened = line.open(f, job.sensor.shutter, job.sensor.subframes)
                shots.append(studio.shoot(line.at(f), seeds[f], opened, line.at(f + 1)))
            each.append(cpu[0])
        frame = min(each[1:])  # what else the machine does only adds
        rgb = np.stack([shot.rgb for shot in shots])
        blocked = mask.hidden(rgb, np.stack([shot.tool for shot in shots]))
        return _Film(rgb, blocked, shots, studio, {"scene": scene[0] + each[0] - frame, "render": frame})


def loaded(job: Job, index: int) -> list[int]:
    """The rest frame and up to `LOADED` frames on the way to the peak of a sequence's load."""
    gestures = scenario.draw(job, index).gestures
    load = np.sum([g.force_mn * tool.course(g, job.frames).load for g in gestures], axis=0)
    if not load.any():
        load[-1] = 1.0
    begin, peak = int(np.flatnonzero(load)[0]), int(load.argmax())
    steps = np.linspace(begin - 1, peak, LOADED + 1).round().astype(int)[1:]
    return [0, *sorted({int(step) for step in steps if step > 0})]


@contextlib.contextmanager
def _timed() -> Iterator[list[float]]:
    """CPU-s of the block, as the list's only item once it has ended."""
    watch, spent = Stopwatch(), [0.0]
    with watch.stage("block"):
        yield spent
    spent[0] = watch.cpu_s("block")
