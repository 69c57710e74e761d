from __future__ import annotations

import tarfile
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What commit f047e99 wrote, unpacked.

    one/ (6 sequences), two/ (a second eye, 1 of 2), rigid/ (a contact that went since), default/ (one
    sequence by the default keys), models/, network.onnx, recording/, pair/ (with a second eye), predictions/,
    full.yaml (every key at its default).
    """
    folder = tmp_path_factory.mktemp("golden")
    with tarfile.open(Path(__file__).with_name("f047e99.tar.xz")) as archive:
        archive.extractall(folder, filter="data")
    return folder
