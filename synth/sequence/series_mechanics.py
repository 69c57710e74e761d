"""Mechanics of a sequence by another program, whose files hold motion and load."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

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
        area, count, opening_mm = rest.vertex_area, series.tip.shape[1], rest.draw.opening_mm
        moved = np.zeros((len(time), len(area), 3))
        load, lost = np.zeros_like(moved), np.zeros((len(time), 3))
        parts, work = np.zeros((len(time), count, 3)), np.zeros(len(time))
        tip, shaft = (np.zeros((len(time), 2 * count, 3)) for _ in range(2))
        for t, now in enumerate(time.tolist()):
            report("fem", t, len(time))
            with watch.stage("fem"):
                moved[t] = transfer.move(series.at(now, "displacement") @ turn.T)
                tip[t] = np.repeat(series.at(now, "tip") @ turn.T + shift, 2, axis=0)
                towards = np.repeat(series.at(now, "shaft") @ turn.T, 2, axis=0)
                shaft[t] = towards / np.linalg.norm(towards, axis=1, keepdims=True)
                if series.force is not None:
                    force = series.at(now, "force") @ turn.T
                    load[t] = transfer.bear(force)
                    lost[t] = force.sum(axis=0) - load[t].sum(axis=0)
                    if count:  # a vertex's load belongs to the nearest tip
                        away = (rest.surface.vertices + moved[t])[:, None] - tip[t, ::2]
                        nearest = np.linalg.norm(away, axis=2).argmin(axis=1)
                        parts[t] = [load[t][nearest == k].sum(axis=0) for k in range(count)]
                    work[t] = 0.5 * (load[t] * moved[t]).sum()
        steps = np.linalg.norm(np.diff(moved, axis=0), axis=2).max(axis=1)
        corners = series.points[series.faces]
        cell = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
        cautions = list(series.cautions)
        if (step := float(steps.max())) > cell and not any(
            caution.startswith("nodes") for caution in cautions
        ):
            between = f"from frame {steps.argmax()} to the next, more than a cell of the mesh, {cell:.2g} mm"
            cautions.append(f"the surface moves by {step:.2g} mm {between}: store more states, or raise fps")
        whole, hidden = load.sum(axis=1), np.hypot(*rest.surface.vertices[:, :2].T) > opening_mm
        outside = float(np.linalg.norm(lost + load[:, hidden].sum(axis=1), axis=1).max())
        if outside > _LOST * (most := max(float(np.linalg.norm(whole + lost, axis=1).max()), outside)):
            share = f"{outside:.3g} mN, {100 * outside / most:.0f}% of the load"
            beyond = f"{np.linalg.norm(lost, axis=1).max():.2f} mN beyond the drawn surface are in no label"
            cautions.append(f"force: {share}, act outside the opening; {beyond}")
        for caution in cautions:
            warnings.warn(f"mechanics.source: {caution}", Caution, stacklevel=1)
        if series.force is None:
            for unknown in (load, whole, parts):
                unknown.fill(np.nan)
        return Deformation(
            displacement=moved,
            traction=load / area[:, None],
            force=whole,
            by_instrument=parts,
            tip=tip,
            shaft=shaft,
            tool_work=None if series.force is None else work,
            cautions=tuple(cautions),
        )
