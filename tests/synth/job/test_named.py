"""Named jobs: all can be drawn, and the page of recipes lists them."""

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


def test_out_of_distribution_appearance_and_anatomy_are_not_in_the_training_data() -> None:
    paths = ("mission", f"{CURVES}/mission-bench.yaml", f"{CURVES}/mission-ood.yaml")
    train, bench, ood = map(reader.load_job, paths)
    assert not set(ood.appearance.families) & {*train.appearance.families, *bench.appearance.families}
    assert ood.anatomy.gyrus_mm[1] <= train.anatomy.gyrus_mm[0]
    assert ood.anatomy.sulcus_mm[1] <= train.anatomy.sulcus_mm[0]
    assert ood.fem == train.fem == bench.fem
    assert len({job.seed for job in (train, bench, ood)}) == 3
