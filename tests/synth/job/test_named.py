"""Jobs that come with the program: all can be drawn, and the page of recipes has them with what it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from synth.job import reader
from synth.job.instrument import CLEAR_MM
from synth.sequence import scenario

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "recipes.md").read_text("utf-8")


@pytest.mark.parametrize("name", reader.names())
def test_it_is_read_drawn_and_on_the_page(name: str) -> None:
    job = reader.load_job(name)
    for index in range(min(job.sequences, 5)):
        assert scenario.draw(job, index).gestures
    assert f"| `{name}` |" in PAGE


def test_each_is_what_it_is_called() -> None:
    stereo, calf, endoscope, living = (
        reader.load_job(name) for name in ("stereo", "ex-vivo-calf", "endoscope", "in-vivo")
    )
    assert stereo.render.stereo_mm == 24
    assert "motion_recovered" in stereo.kept_fields
    assert (calf.appearance.families, calf.fem.contact) == (("calf",), "rigid")
    assert calf.fem.membrane.intact == calf.fem.pulse.heart_mm[1] == 0
    assert endoscope.render.working_distance_mm[1] < 100
    assert endoscope.render.distortion[0] < -0.2
    assert living.fem.membrane.intact == 1
    assert living.fem.pulse.heart_mm[1] > 0


def test_what_the_missions_ask_about_is_never_shown() -> None:
    shown, bench, look, mechanics = (
        reader.load_job(name) for name in ("mission", "mission-bench", "mission-unseen", "mission-mechanics")
    )
    assert not set(look.appearance.families) & set(shown.appearance.families)
    assert look.anatomy.gyrus_mm[1] <= shown.anatomy.gyrus_mm[0]
    assert look.anatomy.sulcus_mm[0] >= shown.anatomy.sulcus_mm[1]
    assert look.fem == shown.fem
    assert (shown.fem.contact, mechanics.fem.contact) == ("traction", "rigid")
    assert shown.fem.pulse.heart_mm[1] == 0 < mechanics.fem.pulse.heart_mm[0]
    assert mechanics.appearance.families == shown.appearance.families
    assert not set(look.appearance.families) & set(bench.appearance.families)
    assert 2 * bench.anatomy.craniotomy.radius_mm > max(bench.render.field_mm)
    assert bench.fem.within_mm is not None
    tall = bench.render.size[1] / bench.render.size[0] * np.mean(bench.render.field_mm)
    assert bench.fem.within_mm - CLEAR_MM <= tall / 2 < bench.anatomy.craniotomy.radius_mm
    assert bench.fem.model_copy(update={"within_mm": None}) == shown.fem
    assert len({job.seed for job in (shown, bench, look, mechanics)}) == 4
