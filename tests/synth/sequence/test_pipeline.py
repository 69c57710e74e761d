"""One sequence: what sequences share and what they don't."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from egg_brain import OPENING, soup, written

from synth.job.schema import Anatomy, Job
from synth.sequence import pipeline, scenario


def test_sequences_of_one_anatomy_share_its_surface() -> None:
    job = Job(sequences=4, frames=2, anatomy=Anatomy(variety=2))
    first, other, again = (pipeline.cortex(job, scenario.draw(job, index))[0] for index in (0, 1, 2))
    assert again is first
    assert not np.array_equal(first.vertices, other.vertices)
    with pytest.raises(ValueError, match="read-only"):
        first.vertices[0] = 0


def test_a_mesh_that_was_replaced_is_read_again(tmp_path: Path) -> None:
    path = written(tmp_path / "egg.stl", soup())
    anatomy = Anatomy(mesh=path, vertices=2500, craniotomy=OPENING, variety=1)
    job = Job(sequences=2, frames=2, anatomy=anatomy)
    first, again = (pipeline.cortex(job, scenario.draw(job, index)) for index in (0, 1))
    assert again[0] is first[0]
    assert again[1] is first[1]
    written(path, 1.01 * soup())
    os.utime(path, (1, 1))
    larger = pipeline.cortex(job, scenario.draw(job, 0))
    assert first[1] is not None
    assert larger[1] is not None
    assert np.ptp(larger[1].vertices[:, 0]) == pytest.approx(1.01 * np.ptp(first[1].vertices[:, 0]))
