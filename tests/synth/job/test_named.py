"""Jobs that come with the program: all can be drawn, and the page of recipes has them with what it says."""

from __future__ import annotations

from pathlib import Path

import pytest

from synth.job import reader
from synth.sequence import scenario

HOME = Path(__file__).resolve().parents[3]
PAGE = (HOME / "docs" / "recipes.md").read_text("utf-8")
CURVES = HOME / "evidence" / "curves"


@pytest.mark.parametrize("name", reader.names())
def test_it_is_read_drawn_and_on_the_page(name: str) -> None:
    job = reader.load_job(name)
    for index in range(min(job.sequences, 5)):
        assert scenario.draw_scenario(job, index).gestures
    assert f"| `{name}` |" in PAGE


def test_what_the_missions_ask_about_is_never_shown() -> None:
    shown, bench, look = map(
        reader.load_job, ("mission", f"{CURVES}/mission-bench.yaml", f"{CURVES}/mission-ood.yaml")
    )
    assert not set(look.appearance.families) & {*shown.appearance.families, *bench.appearance.families}
    assert look.anatomy.gyrus_mm[1] <= shown.anatomy.gyrus_mm[0]
    assert look.anatomy.sulcus_mm[1] <= shown.anatomy.sulcus_mm[0]
    assert look.fem == shown.fem == bench.fem
    assert len({job.seed for job in (shown, bench, look)}) == 3
