"""Instruments: where they end, and that they are whole."""

from typing import get_args

import numpy as np
import pytest
import trimesh

from synth.render import instrument

TIPS = np.array([[-1.0, 0.5, 2.0], [1.0, 0.5, 2.0]])
SHAFTS = np.array([[0.3, 0.2, 0.9], [0.3, 0.2, 0.9]])


@pytest.mark.parametrize("kind", get_args(instrument.Kind))
def test_an_instrument_ends_at_its_tips(kind: instrument.Kind) -> None:
    made = instrument.build([kind], [False])
    points = instrument.pose(made, TIPS, SHAFTS)
    assert np.isfinite(points).all()
    assert made.faces.max() == len(points) - 1
    goals = TIPS if kind in ("forceps", "bayonet") else TIPS.mean(axis=0, keepdims=True)
    for goal in goals:
        assert np.linalg.norm(points - goal, axis=1).min() < 1.3
    # Nothing reaches past the tips, and the rest is on the hand's side.
    along = (points - TIPS.mean(axis=0)) @ (SHAFTS[0] / np.linalg.norm(SHAFTS[0]))
    assert along.min() > -0.4  # the tips are apart, also along the shaft
    assert 100 < along.max() < 120
    assert trimesh.Trimesh(points, made.faces).volume > 50, "faces turn outwards"
