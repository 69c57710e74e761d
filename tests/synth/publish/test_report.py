"""The page about a dataset links to its stores, whatever a foreign index calls them."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest
from fake_work import consistent

from synth.job.schema import Job
from synth.publish import report


@pytest.mark.parametrize("path", ["javascript:alert(1)", "../000000.zarr", "/etc"])
def test_links_lead_to_the_datasets_own_stores(tmp_path: Path, path: str) -> None:
    consistent(Job(sequences=1, frames=2, render={"size": (48, 36)}), 0, tmp_path, lambda *_: None)
    row = {
        "path": path,
        "index": 0,
        "gesture": "pull",
        "family": "pale",
        "peak_force_mn": 1.0,
        "young_kpa": 1.0,
    }
    shown = report._thumbnails(tmp_path, pa.Table.from_pylist([row]))
    assert [one["path"] for one in shown] == ["000000.zarr"]
