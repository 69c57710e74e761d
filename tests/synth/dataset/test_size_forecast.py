"""Forecasts of a sequence's memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_run import Silent

from synth.dataset import size_forecast
from synth.engine.run import Options, run_job
from synth.errors import UserError
from synth.job import reader


@pytest.mark.parametrize(
    ("keys", "measured_mb"),
    [
        (["frames=10", "anatomy.vertices=12000", "render.size=[64, 48]", "flow.backend=ideal"], 603),
        (["frames=300", "anatomy.vertices=12000", "render.size=[64, 48]", "flow.backend=ideal"], 803),
        (["frames=200", "anatomy.vertices=2500", "render.size=[320, 240]", "flow.backend=ideal"], 919),
        (["frames=100", "anatomy.vertices=2500", "render.size=[320, 240]"], 949),
    ],
)
def test_memory_is_what_was_measured(keys: list[str], measured_mb: float) -> None:
    estimate_mb = size_forecast.estimate_memory(reader.load_job("demo", keys)) / 1e6
    assert measured_mb < estimate_mb < 1.5 * measured_mb


def test_a_sequence_too_large_for_a_worker_is_refused_before_it_begins(tmp_path: Path) -> None:
    job = reader.load_job("demo", ["sequences=1", "frames=10000"])
    with pytest.raises(UserError, match=r"10000 frames needs about .* GB of memory .* --workers 1"):
        run_job(job, tmp_path / "out", Options(workers=2, memory_gb=4), Silent())
    assert not (tmp_path / "out").exists()
    size_forecast.refuse_if_too_long(job, None, 1)  # memory is unknown: nothing is refused
