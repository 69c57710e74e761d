"""A rendered pair of eyes agrees with its truth, and gives motion in space back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from synth.checks import stereo
from synth.dataset.store import open_sequence
from synth.job import reader
from synth.sequence.pipeline import render_sequence


@pytest.mark.slow
def test_a_rendered_pair_agrees_and_gives_motion_back(tmp_path: Path) -> None:
    changes = ["frames=4", "render.size=[160,120]", "render.stereo_mm=24"]
    job = reader.load_job("tiny", [*changes, "sequences=1", "render.spp=4"])
    sequence = open_sequence(render_sequence(job, 0, tmp_path, lambda *_: None))
    measures = list(stereo.stereo(sequence, [0, 2]))
    assert len(measures) > 8
    assert all(one.good for one in measures), [one for one in measures if not one.good]
    tissue, found = sequence["tissue"][:], sequence["motion_recovered"][:]
    assert not found[0].any()
    assert not found[:, ~tissue].any()
    assert (sequence["motion_deviation"][2][tissue] > 0).all()
    t = int(np.abs(sequence["motion"][..., 2]).max(axis=(1, 2)).argmax())
    seen = tissue & sequence["visible"][t] & ~sequence["tool"][0]
    error = (found - sequence["motion"][:])[t][seen]
    # At 160 px a pixel of disparity is 2.7 mm of depth.
    assert np.sqrt(np.square(error[:, 2]).mean()) < 0.2
    assert sequence.attrs["right"]["baseline_mm"] == 24
