"""Flow in a process of its own: the same answers, and errors that arrive."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest

from bench.tracking.flow_process import Beside, Here
from synth.errors import UserError


def pictures() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    rest = np.kron(rng.integers(40, 220, (16, 20)), np.ones((4, 4)))[..., None].repeat(3, 2).astype(np.uint8)
    free = np.zeros(rest.shape[:2], bool)
    return rest, np.roll(rest, 2, axis=1), free


def test_the_same_flow_in_both_places() -> None:
    rest, moved, free = pictures()
    beside = Beside()
    found = []
    try:
        for flow in (Here(), beside):
            flow.begin("dis", rest, free, ~free)
            flow.ask(moved, free)
            first = flow.answer()
            flow.ask(rest, free)
            found.append((first, flow.answer()))
    finally:
        beside.close()
    for here, there in zip(*found, strict=True):
        np.testing.assert_array_equal(here.flow, there.flow)
        np.testing.assert_array_equal(here.confidence, there.confidence)
    assert np.abs(found[0][0].flow).max() > 1
    assert found[1][0].peak_bytes > 1e7


def test_errors_of_the_flow_arrive_and_its_end_is_said() -> None:
    rest, moved, free = pictures()
    beside = Beside()
    try:
        with pytest.raises(UserError, match="no estimator"):
            beside.begin("nonesuch", rest, free, ~free)
        beside.begin("dis", rest, free, ~free)
        beside.ask(moved[:-1], free)
        with pytest.raises(UserError, match="does not fit"):
            beside.answer()
        os.kill(beside._process.pid, signal.SIGKILL)
        beside._process.wait()
        with pytest.raises(UserError, match="ended"):
            beside.ask(moved, free)
    finally:
        beside.close()
