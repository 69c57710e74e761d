"""One dataset for all tests in this folder."""

from pathlib import Path

import pytest
from fake_run import in_process
from fake_work import consistent
from made_once import made_once

from synth.dataset import index, sequence_split
from synth.dataset.dataset_folder import Folder
from synth.job.schema import Job

ABOUT = {"title": "Pulls: a test", "licence": "cc-by-4.0", "summary": "A test.", "authors": ["A. Person"]}


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six stereo sequences, with sides, card and description; not to be modified."""
    return made_once(tmp_path_factory, "published", publish) / "out"


def publish(folder: Path) -> None:
    render = {"size": (48, 36), "stereo_mm": 24.0}
    job = Job(sequences=6, frames=3, render=render, flow={"backend": "ideal"}, card=ABOUT)
    in_process(job, folder / "out", consistent)
    rule = sequence_split.parse_rule("anatomy", "0.5,0.25,0.25", [], False)
    index.write_index(Folder(folder / "out"), rule)
