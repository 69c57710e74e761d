"""The size of a force, read from a displacement by a fixed linear rule: what `synth tune` judges settings by.

About a state that is known from full fidelity, the displacement u that a picture shows changes with the size
s of an instrument's force, its place, footprint and direction being known, by the tangent of the physics:
du = (B K^-1 B' f) ds. Least squares on that turns any other displacement of the same frame into the change of
force that would explain it: the dual-weighted residual of goal-oriented error control (Becker and Rannacher,
Acta Numerica 10, 2001) with the force as the goal. It needs no training and has no parameter to tune.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from synth.fem import equilibrium, surface_embedding, tool_gesture
from synth.render import truth
from synth.render.camera import camera
from synth.sequence.mechanics import build
from synth.sequence.scene import Frame, Scene

Floats = NDArray[np.float64]

CELLS = (48, 36)
"""Displacement is averaged over so many cells across and down: the same for every size of picture."""
_FLOOR_MM, _SHARE = 0.02, 0.2
"""Error that recovered flow has where little moves, and as a part of the displacement where much does, in
rendered sequences: cells count by the inverse of its square."""
_TETS = 1600
_STEP_MM = 1e-3


@dataclass(frozen=True)
class Reading:
    """A fixed linear rule for each of K frames."""

    inverse: Floats
    """(K, I, 2 P) part of the sequence's force per mm: I instruments, P cells, x and y in turn."""
    zero: Floats
    """(K, P, 2) mm, the displacement of full fidelity: it reads as no error."""

    def error(self, moved: Floats) -> Floats:
        """How far the force read from (K, P, 2) mm is off, (K, I), as a part of the sequence's force."""
        away = (moved - self.zero).reshape(len(moved), -1)
        return np.asarray(np.einsum("kip,kp->ki", self.inverse, away))


def fit_reading(scene: Scene, frames: Sequence[Frame]) -> Reading:
    """The rule for K frames of a sequence at full fidelity, all with load."""
    case, surface, motion = scene.scenario, scene.surface, scene.motion
    plain = {"law": "neo-hookean", "tets": _TETS, "time": "quasi-static", "relaxation": ()}
    job = scene.job.model_copy(update={"fem": scene.job.fem.model_copy(update=plain)})
    tets = build(job, case)[1]
    system = case.tissue.equations(tets, "neo-hookean")
    embedding = surface_embedding.embed(tets, surface.vertices)
    young = case.tissue.young_kpa
    numbers = [frame.index for frame in frames]
    loads = np.stack([embedding.gather(motion.area[:, None] * motion.traction[t]) for t in numbers]) / young
    path = equilibrium.solve_path(system, loads, np.zeros(len(frames)))
    size_mn = float(np.sqrt(np.square(motion.by_instrument[numbers]).sum(axis=(1, 2)).mean()))
    motions = [tool_gesture.trajectory(gesture, job.frames) for gesture in case.gestures]
    mm_per_px = scene.view.mm_per_px
    true_mm = np.stack([mm_per_px * cells(frame.flow, scene.tissue) for frame in frames])
    rules = []
    for k, t in enumerate(numbers):
        tangent = system.tangent(path.displacement[k])[system.free][:, system.free].tocsc()
        symmetric = {"SymmetricMode": True}
        factors = splu(tangent, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        now = surface.vertices + motion.displacement[t]
        seen = camera.project(scene.view, now)
        columns = []
        for gesture, over_time in zip(case.gestures, motions, strict=True):
            # A load of the sequence's size along the instrument's direction: errors come out as parts of it.
            load = np.zeros_like(tets.points)
            for contact in gesture.contacts:
                centre = np.asarray(contact.point_mm) + over_time.shift[t]
                kernel = tool_gesture.footprint(centre, gesture.footprint_mm, surface.vertices, motion.area)
                load += embedding.gather(np.outer(motion.area * kernel, contact.force_mn))
            load *= size_mn / (young * gesture.force_mn)
            response = np.zeros(load.size)
            response[system.free] = factors.solve(load.ravel()[system.free])
            shift = embedding.move(response.reshape(-1, 3))
            step = _STEP_MM / np.abs(shift).max()
            pixels = (camera.project(scene.view, now + step * shift) - seen) / step
            flow = truth.at_rest_pixels(scene.renderer.rest, surface.faces, pixels)
            columns.append(mm_per_px * cells(flow, scene.tissue).ravel())
        shown_mm = np.stack(columns, axis=1)
        variance = _FLOOR_MM**2 + _SHARE**2 * np.square(true_mm[k]).sum(axis=1)
        weighted = shown_mm.T * np.repeat(_shares(frames[k].visible) / variance, 2)
        rules.append(np.linalg.solve(weighted @ shown_mm, weighted))
    return Reading(np.stack(rules), true_mm)


def cells(values: NDArray[np.float32], tissue: NDArray[np.bool_]) -> Floats:
    """Means (P, C) of (H, W, C) over the tissue in each cell; 0 in cells without any."""
    known = tissue[..., None].astype(np.float32)
    total = cv2.resize(values * known, CELLS, interpolation=cv2.INTER_AREA)
    return np.asarray(total.reshape(-1, values.shape[2]) / np.maximum(_shares(tissue), 1e-6)[:, None])


def _shares(mask: NDArray[np.bool_]) -> Floats:
    """(P,) part of each cell that is in a mask (H, W)."""
    shares = cv2.resize(mask.astype(np.float32), CELLS, interpolation=cv2.INTER_AREA)
    return np.asarray(shares.ravel(), np.float64)
