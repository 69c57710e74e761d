"""One probe sequence of a job: the force error of settings against full fidelity, and their cost.

The dual-weighted residual of goal-oriented error control (Becker and Rannacher, Acta Numerica 10, 2001), with
the force as the goal. Simulated with a little less of an instrument's force, the sequence shows how the
displacement changes with it; least squares turns a frame's other displacement into a force error.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Map
from synth.errors import UserError
from synth.fem.tool_gesture import trajectory
from synth.flow.estimator import create
from synth.job.schema import Job
from synth.render import truth
from synth.render.camera import camera
from synth.sequence.draw import draw_scenario
from synth.sequence.rest_scene import Frame, Scene, at_rest
from synth.sequence.simulation import simulate
from synth.system.stopwatch import Stopwatch

_PARTS = (0.7, 0.85, 1.0)  # of the way to the largest force, where frames are looked at
_CELLS = (48, 36)  # across and down: displacement is averaged over them, for every size of picture
_FLOOR_MM, _SHARE = 0.02, 0.2  # standard deviation of recovered flow: where nothing moves, and per mm
_LESS = 0.05  # of a force: little enough to be linear, and never out of a law's range
_FAINT = 0.1  # of the sequence's force: an instrument with less has no error in a frame


class Probe:
    """The first sequence of a job at full fidelity, against which settings are measured."""

    def __init__(self, job: Job) -> None:
        """UserError if the sequence cannot be carried out, or shows no force."""
        scene = simulate(job)  # which also compiles what all others need: it counts for no cost
        frames = [scene.frame(round(part * scene.strongest)) for part in _PARTS]
        self._numbers, self._attempt = [frame.index for frame in frames], scene.scenario.attempt
        self._weights = linearise(scene, frames)
        self._true_mm = np.stack([cells_mm(scene, frame.flow) for frame in frames])

    def measure(self, job: Job) -> list[float]:
        """The sequence with the settings of `job`. UserError if they cannot carry it out.

        Parts of the force: its error of the true, and of the recovered displacement (the true one where none
        is); CPU-s a frame of physics, scene, rendering and flow, all above 0.
        """
        at_rest(job)  # grows the surface, which stays in memory for other settings: it counts for none
        watch = Stopwatch()
        with watch.stage("physics"):
            scene = simulate(job, case=draw_scenario(job, 0, self._attempt))
        with watch.stage("scene"):  # the first frame prepares it
            rest = scene.frame(0)
        with watch.stage("rendering"):
            frames = [scene.frame(t) for t in self._numbers]
        label = recovered = self._error(scene, [frame.flow for frame in frames])
        if job.flow.backend != "ideal":
            with watch.stage("flow"):  # the first step starts cold and costs as much as two of a video
                track = scene.recover_flow([rest, *frames], create(job.flow.backend))
            recovered = self._error(scene, track.flow[1:])
        rendering_s, flow_s = watch.cpu_s("rendering") / len(frames), watch.cpu_s("flow") / (1 + len(frames))
        sequence_s = watch.cpu_s("physics"), watch.cpu_s("scene") - rendering_s
        stages = [*(seconds / job.frames for seconds in sequence_s), rendering_s, flow_s]
        return [label, recovered, *(max(1e-6, seconds) for seconds in stages)]

    def _error(self, scene: Scene, flows: Iterable[Map]) -> float:
        """Root mean square over frames, instruments together."""
        residual = np.stack([cells_mm(scene, flow) for flow in flows]) - self._true_mm
        errors = np.einsum("kip,kp->ki", self._weights, residual.reshape(len(residual), -1))
        return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def linearise(scene: Scene, frames: list[Frame]) -> Floats:
    """Weights (K, I, 2 P) of P cells, x and y in turn, in K frames of a sequence at full fidelity.

    Their sum over errors of displacement, mm, is the error of I instruments' forces, as a part of the
    sequence's force. UserError if nothing that an instrument moves is visible.
    """
    numbers, rest = [frame.index for frame in frames], scene.surface.vertices
    force = np.linalg.norm(scene.motion.by_instrument[numbers], axis=2)  # (K, I) mN
    force /= max(np.sqrt(np.square(force).sum(axis=1).mean()), 1e-9)
    true_mm = np.stack([cells_mm(scene, frame.flow) for frame in frames])
    responses = np.zeros((*force.shape, true_mm[0].size))
    trajectories = [trajectory(gesture, scene.job.frames) for gesture in scene.scenario.gestures]
    for i, stronger in enumerate(trajectories):
        weaker = [
            *trajectories[:i],
            replace(stronger, load=(1 - _LESS) * stronger.load),
            *trajectories[i + 1 :],
        ]
        displacement = simulate(scene.dataset, case=scene.scenario, motions=weaker).motion.displacement
        for k in np.flatnonzero(force[:, i] >= _FAINT):
            states = (rest + state[numbers[k]] for state in (scene.motion.displacement, displacement))
            pixels = np.subtract(*(camera.project(scene.view, state) for state in states))
            flow = truth.at_rest_pixels(scene.renderer.rest, scene.surface.faces, pixels)
            responses[k, i] = cells_mm(scene, flow).ravel() / (_LESS * force[k, i])
    variance = _FLOOR_MM**2 + _SHARE**2 * np.square(true_mm).sum(axis=2)
    visible = np.stack([_cells(frame.visible[..., None]) for frame in frames])
    root = np.sqrt(visible / variance[..., None]).repeat(2, axis=2).reshape(len(frames), 1, -1)
    if not (responses * root).any(axis=(0, 2)).all():
        raise UserError("a sequence of the job shows no force of an instrument; give it more frames")
    return np.asarray(np.linalg.pinv(responses * root).swapaxes(1, 2) * root)


def cells_mm(scene: Scene, flow: Map) -> Floats:
    """Means (P, 2) mm of flow (H, W, 2) px over the tissue in each cell; 0 in cells without any."""
    tissue = scene.tissue[..., None]
    return np.asarray(scene.view.mm_per_px * _cells(flow * tissue) / np.maximum(_cells(tissue), 1e-6))


def _cells(values: NDArray[np.generic]) -> Floats:
    """Means (P, C) of (H, W, C)."""
    means = cv2.resize(values.astype(np.float32), _CELLS, interpolation=cv2.INTER_AREA)
    return np.asarray(means.reshape(-1, values.shape[2]), np.float64)
