"""Mechanics of a sequence by another program, whose files hold motion and load."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats
from synth.errors import Caution, UserError
from synth.fem.deformation import Deformation
from synth.fem.external.transfer import attach
from synth.sequence.rest_scene import RestScene
from synth.system.stopwatch import StageCallback, Stopwatch

_LOST = 0.01  # share of the load outside the opening above which it is reported


@dataclass(frozen=True)
class SeriesMechanics:
    """Motion and load of a scene as another program computed them: those of `mechanics.source`."""

    def deform(self, rest: RestScene, report: StageCallback, watch: Stopwatch, /) -> Deformation:
        """As `Mechanics.deform`. UserError: the series is shorter than the job."""
        series, time, job = rest.series, rest.time, rest.job
        assert series is not None
        assert rest.brain is not None
        if time[-1] > series.time[-1] + 1e-6:
            fit, last = int(series.time[-1] * job.fps + 1e-6) + 1, float(series.time[-1])
            raise UserError(
                f"frames: mechanics.source lasts {last:.4g} s, {job.frames} frames at {job.fps:g} fps "
                f"{time[-1]:.4g} s; frames={fit}, or fps={(job.frames - 1) / last:.4g}, fits"
            )
        turn, shift = rest.brain.to_world[:3, :3], rest.brain.to_world[:3, 3]
        with watch.stage("mesh"):
            transfer = attach(series.points @ turn.T + shift, series.faces, rest.shape)
        area, count = rest.vertex_area, series.tip.shape[1]
        displacement = np.zeros((len(time), len(area), 3))
        load, lost_force = np.zeros_like(displacement), np.zeros((len(time), 3))
        instrument_forces, work = np.zeros((len(time), count, 3)), np.zeros(len(time))
        tip, shaft = (np.zeros((len(time), 2 * count, 3)) for _ in range(2))
        for t, time_s in enumerate(time.tolist()):
            report("fem", t, len(time))
            with watch.stage("fem"):
                displacement[t] = transfer.move(series.at(time_s, "displacement") @ turn.T)
                tip[t] = np.repeat(series.at(time_s, "tip") @ turn.T + shift, 2, axis=0)
                towards = np.repeat(series.at(time_s, "shaft") @ turn.T, 2, axis=0)
                shaft[t] = towards / np.linalg.norm(towards, axis=1, keepdims=True)
                if series.force is not None:
                    force = series.at(time_s, "force") @ turn.T
                    load[t] = transfer.bear(force)
                    lost_force[t] = force.sum(axis=0) - load[t].sum(axis=0)
                    if count:  # a vertex's load belongs to the nearest tip
                        offsets = (rest.surface.vertices + displacement[t])[:, None] - tip[t, ::2]
                        nearest = np.linalg.norm(offsets, axis=2).argmin(axis=1)
                        instrument_forces[t] = [load[t][nearest == k].sum(axis=0) for k in range(count)]
                    work[t] = 0.5 * (load[t] * displacement[t]).sum()
        cautions = _list_cautions(rest, displacement, load, lost_force)
        for caution in cautions:
            warnings.warn(f"mechanics.source: {caution}", Caution, stacklevel=1)
        total_force = load.sum(axis=1)
        if series.force is None:
            for values in (load, total_force, instrument_forces):
                values.fill(np.nan)
        return Deformation(
            displacement=displacement,
            traction=load / area[:, None],
            force=total_force,
            by_instrument=instrument_forces,
            tip=tip,
            shaft=shaft,
            tool_work=None if series.force is None else work,
            cautions=tuple(cautions),
        )


def _list_cautions(rest: RestScene, displacement: Floats, load: Floats, lost_force: Floats) -> list[str]:
    """What is doubtful about a scene's series and its transfer to the drawn surface.

    `displacement` and `load`: (T, V, 3) mm and mN at vertices; `lost_force`: (T, 3) mN beyond the surface.
    """
    series = rest.series
    assert series is not None
    steps = np.linalg.norm(np.diff(displacement, axis=0), axis=2).max(axis=1)
    corners = series.points[series.faces]
    cell = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    cautions = list(series.cautions)
    if (step := float(steps.max())) > cell and not any(caution.startswith("nodes") for caution in cautions):
        between = f"from frame {steps.argmax()} to the next, more than a cell of the mesh, {cell:.2g} mm"
        cautions.append(f"the surface moves by {step:.2g} mm {between}: store more states, or raise fps")
    total_force = load.sum(axis=1) + lost_force
    hidden = np.hypot(*rest.surface.vertices[:, :2].T) > rest.draw.opening_mm
    outside = float(np.linalg.norm(lost_force + load[:, hidden].sum(axis=1), axis=1).max())
    largest = max(float(np.linalg.norm(total_force, axis=1).max()), outside)
    if outside > _LOST * largest:
        share = f"{outside:.3g} mN, {100 * outside / largest:.0f}% of the load"
        lost = np.linalg.norm(lost_force, axis=1).max()
        beyond = f"{lost:.2f} mN beyond the drawn surface are in no label"
        cautions.append(f"force: {share}, act outside the opening; {beyond}")
    return cautions
