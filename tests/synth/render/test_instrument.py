"""Instruments: where they end, that they are whole, and that each gesture has one."""

from typing import get_args

import numpy as np
import pytest
import trimesh

from synth.errors import UserError
from synth.job.schema import Fem
from synth.render import instrument

TIPS = np.array([[-1.0, 0.5, 2.0], [1.0, 0.5, 2.0]])
SHAFTS = np.array([[0.3, 0.2, 0.9], [0.3, 0.2, 0.9]])


@pytest.mark.parametrize("kind", get_args(instrument.Kind))
def test_an_instrument_ends_at_its_tips(kind: instrument.Kind) -> None:
    made = instrument.build([kind])
    points = instrument.pose(made, TIPS, SHAFTS)
    assert np.isfinite(points).all()
    assert made.faces.max() == len(points) - 1
    goals = TIPS if kind == "forceps" else TIPS.mean(axis=0, keepdims=True)
    for goal in goals:
        assert np.linalg.norm(points - goal, axis=1).min() < 1.3
    # Nothing reaches past the tips, and the rest is on the hand's side.
    along = (points - TIPS.mean(axis=0)) @ (SHAFTS[0] / np.linalg.norm(SHAFTS[0]))
    assert along.min() > -0.4  # the tips are apart, also along the shaft
    assert 100 < along.max() < 120


@pytest.mark.parametrize("kind", get_args(instrument.Kind))
def test_faces_turn_outwards(kind: instrument.Kind) -> None:
    made = instrument.build([kind])
    mesh = trimesh.Trimesh(instrument.pose(made, TIPS, SHAFTS), made.faces, process=True)
    assert mesh.volume > 50


def test_several_instruments_follow_their_own_tips() -> None:
    made = instrument.build(["forceps", "suction"])
    other = TIPS + np.array([6.0, 0.0, 0.0])
    points = instrument.pose(made, np.concatenate([TIPS, other]), np.concatenate([SHAFTS, SHAFTS]))
    alone = instrument.pose(instrument.build(["suction"]), other, SHAFTS)
    np.testing.assert_allclose(points[-len(alone) :], alone)
    with pytest.raises(UserError, match="2 tips for 2 instruments"):
        instrument.pose(made, TIPS, SHAFTS)


def test_a_shaft_along_any_axis_has_a_frame() -> None:
    for shaft in ([0.0, 0, 1], [1.0, 0, 0], [0, 1.0, 0]):
        ways = np.array([shaft, shaft])
        assert np.isfinite(instrument.pose(instrument.build(["dissector"]), TIPS, ways)).all()


def test_every_gesture_has_an_instrument() -> None:
    gestures = Fem().gestures
    for seed in range(5):
        kinds = instrument.choose(gestures, np.random.default_rng(seed))
        assert len(kinds) == len(gestures)
        assert kinds[gestures.index("grasp")] == "forceps"
