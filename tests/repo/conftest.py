from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered dataset of one short sequence, as the README's commands would leave it."""
    from synth.job import reader
    from synth.sequence import pipeline

    small = ["sequences=1", "seed=3", "anatomy.vertices=2500", "fem.tets=400", "render.spp=2"]
    folder = tmp_path_factory.mktemp("repo") / "out"
    folder.mkdir()
    pipeline.render_sequence(reader.load_job("tiny", small), 0, folder, lambda stage, done, of: None)
    return folder
