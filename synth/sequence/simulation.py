"""Simulation of one sequence: drawn, built and deformed, ready to be rendered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

from synth.arguments import checked
from synth.errors import UserError
from synth.fem.deformation import check_deformation
from synth.fem.equilibrium import ExcessiveLoad
from synth.fem.tool_gesture import ToolMotion, trajectory
from synth.job.reader import as_job
from synth.job.schema import Job
from synth.render.content import SceneContent
from synth.sequence.draw import Draw, draw
from synth.sequence.fem_mechanics import FemMechanics
from synth.sequence.mechanics import Mechanics
from synth.sequence.rest_scene import RestScene, Scene, build
from synth.sequence.scenario import ATTEMPTS, DRIVEN_ATTEMPTS, Scenario
from synth.sequence.series_mechanics import SeriesMechanics
from synth.system.stopwatch import StageCallback, Stopwatch


@checked
def simulate(
    job: Job | str | Path,
    index: int = 0,
    report: StageCallback | None = None,
    watch: Stopwatch | None = None,
    *,
    case: Scenario | None = None,
    motions: Sequence[ToolMotion] = (),
    mechanics: Mechanics | None = None,
    content: Callable[[RestScene], SceneContent] | None = None,
) -> Scene:
    """Builds sequence `index` of a job and simulates its gestures; nothing is rendered or written yet.

    Without `case`, `motions`, `mechanics` and `content` the scene is the one that `synth render` computes for
    that job and index. Gestures whose loads the mesh does not bear are then drawn anew, up to three times,
    unless the job states the load of an instrument.

    Args:
        job: the job, or its file or name as for `load_job`; its `sequences` only limits `index`.
        index: number of the sequence, 0 <= index < job.sequences.
        report: called with progress, stage by stage.
        watch: adds up the time of each stage.
        case: a scenario to use instead of the drawn one; its camera motion may be any dataclass with a method
            `at` like that of `CameraMotion`.
        motions: of its instruments, over T frames each, instead of the gestures' own trajectories.
        mechanics: what moves the surface instead of this package's finite elements; it has no `motions`.
        content: as for `at_rest`.

    Raises:
        UserError: no such sequence, a job that cannot be carried out (surface, load, inverted element), or
            mechanics with an invalid result.
    """
    job = as_job(job)
    if index not in range(job.sequences):
        raise UserError(f"sequence {index}: the job has sequences 0 to {job.sequences - 1}")
    if mechanics is not None and len(motions):
        raise UserError("simulate: motions are for the built-in mechanics; give either motions or mechanics")
    ours = isinstance(mechanics, FemMechanics | None) and not len(motions)
    has_stated_load = any(
        instrument.load or instrument.force_mn or instrument.travel_mm
        for instrument in job.fem.instrument_list
    )
    sequence_draw = draw(job, index, case=case)
    driven = any(gesture.drive for gesture in sequence_draw.scenario.gestures)
    redraws = 0 if case or has_stated_load or not ours else (DRIVEN_ATTEMPTS if driven else ATTEMPTS) - 1
    report, watch = report or (lambda stage, done, of: None), watch or Stopwatch()
    report("mesh", 0, 1)
    mechanics = mechanics or (FemMechanics(motions) if job.mechanics.source is None else SeriesMechanics())
    while True:
        if ours:
            refuse_untouched(sequence_draw)
        with watch.stage("mesh"):
            rest = build(sequence_draw, content)
        try:
            motion = mechanics.deform(rest, report, watch)
            break
        except ExcessiveLoad:
            if sequence_draw.scenario.attempt >= redraws:
                raise
            sequence_draw = draw(job, index, sequence_draw.scenario.attempt + 1)
    acting_count = len(rest.instruments) - len(sequence_draw.scenario.idle)
    check_deformation(motion, rest.shape, job.frames, acting_count, "force" in job.stored_fields)
    return Scene(**{field.name: getattr(rest, field.name) for field in fields(rest)}, motion=motion)


def refuse_untouched(sequence_draw: Draw) -> None:
    """Raises UserError for an instrument whose contact falls between two frames."""
    job = sequence_draw.job
    for k, gesture in enumerate(sequence_draw.scenario.gestures):
        if not trajectory(gesture, job.frames).load.max() > 1e-6:
            touch, leave = (f"{part * (job.frames - 1) / job.fps:.3g}" for part in gesture.timing[::3])
            when = f"from {touch} to {leave} s falls between two frames, {1 / job.fps:.3g} s apart"
            raise UserError(f"instrument {k}: its contact {when}; make it longer, or raise frames")
