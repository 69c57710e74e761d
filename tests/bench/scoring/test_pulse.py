"""A cortex that beats, from the pictures to the scores: FEM contacts, a beat in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.methods import baselines
from bench.methods.protocol import Method
from evidence.end_to_end import models
from evidence.scoring import pulse as experiment


@pytest.mark.slow
def test_a_beating_recording_scores_as_a_still_one(tmp_path: Path) -> None:
    size, name = 128, "physics, frame by frame"
    methods: dict[str, Method] = {name: baselines.Baseline(models.read_bare)}
    contact = experiment.draw_contact(np.random.default_rng(3), 15.0, size)
    runs = {}
    for what, beats, remove in (("still", 0, True), ("off", 1, True), ("in", 1, False)):
        folder = tmp_path / what
        experiment.record(folder, contact, beats, size, remove, np.random.default_rng(4))
        runs[what] = experiment.score(folder, methods, "dis")
    assert runs["still"].followed.pulse == []
    rates = [rhythm["rate_hz"] for rhythm in runs["off"].followed.pulse]
    assert rates == pytest.approx([1.2, 0.25], rel=0.03)
    errors = {what: run.methods[name].scores["mae_mn"] for what, run in runs.items()}
    # Physics errs by 0.9% of the peak where nothing beats; the beat that is left adds another percent.
    sensor = runs["still"].sensor_mn
    assert sensor is not None
    peak = float(np.nanmax(sensor))
    assert errors["off"] < errors["still"] + 0.02 * peak
    assert errors["in"] > 1.5 * errors["still"], "a beat that harms nobody proves nothing"
