"""Slip at the skull: tissue beside the opening keeps its distance to the bone and moves along it."""

from __future__ import annotations

import numpy as np
import pytest
from dome import ANATOMY

from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import boundary
from synth.fem.motion import Clock, march_in_time
from synth.fem.system import assemble


def test_slip_holds_along_the_normal_as_firmly_and_along_the_surface_not_at_all() -> None:
    bonded = tetrahedra.block(ANATOMY, 300)
    slipping = tetrahedra.block(ANATOMY, 300, slips=True)
    assert bonded.slip is None
    assert slipping.slip is not None
    soft, firm = assemble(slipping, "linear", 0.4), assemble(bonded, "linear", 0.4)
    top = boundary(bonded.cells)
    top = np.unique(top[~bonded.fixed[top].all(axis=1)])
    normal = np.zeros_like(bonded.points)
    normal[top] = bonded.points[top] + [0, 0, ANATOMY.dome_mm]  # the dome's centre
    shallow = top[bonded.points[top, 2] > -20]
    normal[np.setdiff1d(np.arange(len(normal)), shallow)] = 0
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    along = np.cross(normal, [1.0, 0.3, 0.0])

    def held(u: np.ndarray) -> tuple[float, float]:
        return float(np.vdot(u, soft.springs(u))), float(np.vdot(u, firm.springs(u)))

    slip, bond = held(normal)
    assert slip == pytest.approx(bond, rel=0.04)  # coarse faces on a round dome
    slip, bond = held(along)
    assert slip < 0.02 * bond


def test_the_same_springs_in_motion_come_to_rest_where_equilibrium_is() -> None:
    tets = tetrahedra.block(ANATOMY, 300, slips=True)
    load = np.zeros_like(tets.points)
    load[np.hypot(*tets.points[:, :2].T) < 15] = [0.05, 0.0, -0.02]
    frames = 40
    clock = Clock(0.5, 1, 1.0, 20.0)
    found = march_in_time(
        tets, Tissue(1.0, 0.4, "linear"), np.stack([load] * frames), np.full(frames, 0.1), clock
    )
    still = assemble(tets, "linear", 0.4).solve(load)
    assert np.abs(found.displacement[-1] - still).max() <= 2e-3 * np.abs(still).max()
    assert found.energy[-1] == pytest.approx(0.5 * float(np.vdot(load, still)), rel=5e-3)
