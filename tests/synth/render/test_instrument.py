"""Instruments: where they end, that they are whole, and that each gesture has one."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import trimesh

from synth.errors import UserError
from synth.geometry.triangles import Shape
from synth.job.schema import Fem
from synth.render import instrument
from synth.render.appearance import reflection
from synth.render.mitsuba.adapter import Lamp

TIPS = np.array([[-1.0, 0.5, 2.0], [1.0, 0.5, 2.0]])
SHAFTS = np.array([[0.3, 0.2, 0.9], [0.3, 0.2, 0.9]])


@pytest.mark.parametrize("kind", get_args(instrument.Kind))
def test_an_instrument_ends_at_its_tips(kind: instrument.Kind) -> None:
    made = instrument.build([kind])
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
        assert kinds[gestures.index("grasp")] in ("forceps", "bayonet")


def test_a_bayonet_takes_the_hand_aside_and_leaves_the_tips() -> None:
    straight, bent = (
        instrument.pose(instrument.build([kind]), TIPS, SHAFTS) for kind in ("forceps", "bayonet")
    )
    along = (straight - TIPS.mean(axis=0)) @ (SHAFTS[0] / np.linalg.norm(SHAFTS[0]))
    shift = np.linalg.norm(bent - straight, axis=1)
    assert shift[along < 20].max() < 1e-9
    np.testing.assert_allclose(shift[along > 60], 13.0, atol=0.1)
    across = bent[along > 60].mean(axis=0) - straight[along > 60].mean(axis=0)
    assert abs(across @ (TIPS[1] - TIPS[0])) < 1e-6, "the tines stay side by side"


def test_a_coating_covers_the_end_alone() -> None:
    made = instrument.build(["forceps", "suction"], [True, False])
    tips = np.concatenate([TIPS, TIPS])
    points = instrument.pose(made, tips, np.concatenate([SHAFTS, SHAFTS]))
    along = (points - TIPS.mean(axis=0)) @ (SHAFTS[0] / np.linalg.norm(SHAFTS[0]))
    first = sum(len(part.profile) for part in made.parts[0])
    assert (made.coat[:first][along[:first] < 9] > 0.99).all()
    assert (made.coat[:first][along[:first] > 13] < 0.01).all()
    assert not made.coat[first:].any()
    drawn = [instrument.finish(["forceps"], np.random.default_rng(seed))[0] for seed in range(300)]
    assert np.mean(drawn) == pytest.approx(0.4, abs=0.1)


def test_steel_mirrors_the_wound_below_it_and_the_lamps_above() -> None:
    square = np.array([[0.0, 0, 6], [1, 0, 6], [1, 1, 6], [0, 1, 6]])
    eye = np.array([0.0, 0.0, 300.0])
    wound = np.zeros((8, 8, 3), np.float32)
    wound[..., 0] = 0.9
    lamp = Lamp(np.array([10.0, 0, 300]), np.zeros(3), 3.0, (3e5, 3e5, 3e5), 1.0)
    theatre = reflection.Theatre(wound, 40.0, (), (1.0, 1.0, 1.0), 1)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    bare, black = np.zeros(4, np.float32), np.ones(4, np.float32)
    # Turned by 60 degrees a face that is seen mirrors what lies below it.
    c, s = 0.5, np.sqrt(0.75)
    tilted = Shape((square - square[0]) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + square[0], faces)
    seen = reflection.glow(tilted, bare, eye, theatre)
    assert (seen[:, 0] > 3 * seen[:, 1]).all()
    warm = reflection.glow(tilted, bare, eye, replace(theatre, light=(1.2, 1.0, 0.5)))
    np.testing.assert_allclose(warm, seen * [1.2, 1.0, 0.5])
    # Lying flat it mirrors the lamp beside the lens, many times what a black coat does.
    flat = Shape(square, faces)
    lit, dark = (reflection.glow(flat, bare, eye, replace(theatre, lamps=lamps)) for lamps in ((lamp,), ()))
    assert (lit > dark + 0.5).all()
    coated = reflection.glow(flat, black, eye, replace(theatre, lamps=(lamp,)))
    assert (coated < 0.15 * lit).all()
