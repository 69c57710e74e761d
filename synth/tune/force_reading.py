"""The size of a force, read from a displacement by a fixed linear rule: what `synth tune` measures knobs by.

About a state that is known from full fidelity, the displacement u that a picture shows changes with the size
s of an instrument's force, its place, footprint and direction being known, by the tangent of the physics:
du = (B K^-1 B' f) ds. Least squares on that turns any other displacement of the same frame into the change of
force that would explain it: the dual-weighted residual of goal-oriented error control (Becker and Rannacher,
Acta Numerica 10, 2001) with the force as the goal. It needs no training and has no parameter to tune.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from synth.fem import equilibrium, surface_embedding, tool
from synth.fem.solver import Deformation
from synth.fem.system import System
from synth.job.schema import Job
from synth.render import truth
from synth.render.anatomy.surface import Surface
from synth.render.camera import camera as cameras
from synth.render.camera.camera import Camera
from synth.render.truth import Still
from synth.sequence import pipeline
from synth.sequence.scenario import Scenario

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


def fit_reading(
    job: Job,
    case: Scenario,
    surface: Surface,
    motion: Deformation,
    frames: list[int],
    still: Still,
    camera: Camera,
    moved: Floats,
    visible: Floats,
) -> Reading:
    """The rule for some frames of a sequence at full fidelity.

    Args:
        job, case: the sequence.
        surface, motion: its surface and how that moves.
        frames: K frames with load.
        still, camera: truth and microscope at rest.
        moved: (K, P, 2) mm of the true displacement in the cells.
        visible: (K, P) part of each cell that shows tissue then.
    """
    plain = job.fem.model_copy(
        update={"law": "neo-hookean", "order": 2, "tets": _TETS, "time": "quasi-static", "relaxation": ()}
    )
    tets = pipeline.build(job.model_copy(update={"fem": plain}), case)[1]
    system = case.tissue.equations(tets, "neo-hookean")
    carry = surface_embedding.embed(tets, surface.vertices)
    young = case.tissue.young_kpa
    loads = np.stack([carry.gather(motion.area[:, None] * motion.traction[f]) for f in frames]) / young
    path = equilibrium.solve_path(system, loads, np.zeros(len(frames)))
    size = float(np.sqrt(np.square(motion.by_instrument[frames]).sum(axis=(1, 2)).mean()))
    courses = [tool.course(gesture, job.frames) for gesture in case.gestures]
    rules = []
    for k, frame in enumerate(frames):
        factor = _factorise(system, path.displacement[k])
        now = surface.vertices + motion.displacement[frame]
        seen = cameras.project(camera, now)
        columns = []
        for gesture, over in zip(case.gestures, courses, strict=True):
            # A load of the sequence's size along the instrument's direction: errors come out as parts of it.
            pull = np.zeros_like(tets.points)
            for contact in gesture.contacts:
                centre = np.asarray(contact.point_mm) + over.shift[frame]
                kernel = tool.footprint(centre, gesture.footprint_mm, surface.vertices, motion.area)
                pull += carry.gather(np.outer(motion.area * kernel, contact.force_mn))
            pull *= size / (young * gesture.force_mn)
            answer = np.zeros(pull.size)
            answer[system.free] = factor.solve(pull.ravel()[system.free])
            way = carry.move(answer.reshape(-1, 3))
            step = _STEP_MM / np.abs(way).max()
            flow = (cameras.project(camera, now + step * way) - seen) / step
            columns.append(cells(truth.at_rest_pixels(still, surface.faces, flow), still.tissue))
        shown_mm = camera.mm_per_px * np.stack([column.ravel() for column in columns], axis=1)
        rules.append(_solve_rule(shown_mm, moved[k], visible[k]))
    return Reading(np.stack(rules), moved)


def _factorise(system: System, displacement: Floats) -> Any:
    """The sparse LU factors of the tangent (free, free) at a displacement."""
    tangent = system.tangent(displacement)[system.free][:, system.free].tocsc()
    options = {"SymmetricMode": True}
    return splu(tangent, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def _solve_rule(a: Floats, moved: Floats, visible: Floats) -> Floats:
    """Weighted least squares: (I, 2 P) that turns displacement [mm] into parts of each instrument's force.

    Args:
        a: (2 P, I) mm that a load of the sequence's size shows in the cells.
        moved: (P, 2) mm of the true displacement.
        visible: (P,) part of each cell that shows tissue.
    """
    sure = visible / (_FLOOR_MM**2 + _SHARE**2 * np.square(moved).sum(axis=1))
    weighted = a.T * np.repeat(sure, 2)
    return np.linalg.solve(weighted @ a, weighted)


def cells(values: NDArray[Any], on: NDArray[np.bool_]) -> Floats:
    """Means of (H, W, C) over the cells, (P, C), of what is `on` (H, W); 0 in cells without any."""
    known = on.astype(np.float32)
    total = cv2.resize(np.asarray(values, np.float32) * known[..., None], CELLS, interpolation=cv2.INTER_AREA)
    share = cv2.resize(known, CELLS, interpolation=cv2.INTER_AREA)
    mean = total.reshape(*share.shape, -1) / np.maximum(share, 1e-6)[..., None]
    return np.asarray(mean.reshape(-1, mean.shape[-1]), np.float64)


def shown(visible: NDArray[np.bool_], on: NDArray[np.bool_]) -> Floats:
    """(P,) part of each cell that is `visible` tissue."""
    part = cv2.resize((visible & on).astype(np.float32), CELLS, interpolation=cv2.INTER_AREA)
    return np.asarray(part.ravel(), np.float64)
