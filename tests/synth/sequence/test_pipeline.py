"""One sequence: what sequences share and what they don't."""

from __future__ import annotations

import numpy as np

from synth.job.schema import AnatomySection, Job
from synth.sequence import mechanics, scenario


def test_sequences_of_one_anatomy_share_its_surface() -> None:
    job = Job(sequences=4, frames=2, anatomy=AnatomySection(variety=2))
    drawn = [scenario.draw_scenario(job, index) for index in (0, 1, 2)]
    first, other, again = (mechanics.cortex(job, case)[0] for case in drawn)
    assert again is first
    assert not np.array_equal(first.vertices, other.vertices)
    assert not first.vertices.flags.writeable
