"""A pulsating cortex, from pictures to scores: FEM contacts, pulse in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.methods import baselines
from bench.methods.protocol import Method
from evidence.end_to_end import models
from evidence.scoring import pulse as experiment


@pytest.mark.slow
def test_a_pulsating_recording_scores_like_a_still_one(tmp_path: Path) -> None:
    size, name = 128, "physics, frame by frame"
    methods: dict[str, Method] = {name: baselines.Baseline(models.read_bare)}
    contact = experiment.draw_contact(np.random.default_rng(3), 15.0, size)
    runs = {}
    for what, pulses, remove in (("still", 0, True), ("off", 1, True), ("in", 1, False)):
        folder = tmp_path / what
        experiment.record(folder, contact, pulses, size, remove, np.random.default_rng(4))
        runs[what] = experiment.score(folder, methods, "dis")
    assert runs["still"].tracked.pulse == []
    rates = [rhythm["rate_hz"] for rhythm in runs["off"].tracked.pulse]
    assert rates == pytest.approx([1.2, 0.25], rel=0.03)
    errors = {what: run.methods[name].scores["mae_mn"] for what, run in runs.items()}
    # The error is 0.9% of the peak without a pulse; the residual pulse adds another percent.
    sensor = runs["still"].sensor_mn
    assert sensor is not None
    peak = float(np.nanmax(sensor))
    assert errors["off"] < errors["still"] + 0.02 * peak
    assert errors["in"] > 1.5 * errors["still"], "the pulse must matter if it is not removed"
