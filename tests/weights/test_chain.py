"""The chain that trains all weights below the force, in small."""

import hashlib
import json
from pathlib import Path
from unittest.mock import Mock

import pytest

from synth.flow import correction, segmentation
from synth.flow.stereo import depth_correction
from weights import chain, correction_training, segmentation_training


@pytest.mark.slow
@pytest.mark.trial
def test_weights_are_made_from_nothing_and_cards_name_those_below(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = {"randomized": 1, "mission": 1, "drawn": 4, "steps": 2, "minutes": 0.02}
    for part in (segmentation, correction, depth_correction):
        monkeypatch.setattr(part, "WEIGHTS", part.WEIGHTS)  # set back afterwards
    chain.make(tmp_path / "work", **sizes)
    cards = {file.stem: json.loads(file.read_text()) for file in (tmp_path / "work/made").glob("*.json")}
    assert cards["segmentation"]["below"] == {}
    first = hashlib.sha256((tmp_path / "work/made/segmentation.onnx").read_bytes()).hexdigest()
    assert first.startswith(cards["depth_correction"]["below"]["segmentation"])
    assert set(cards["depth_correction"]["below"]) == {"segmentation", "correction"}
    makers = (chain, "_render_arrays"), (segmentation_training, "train"), (correction_training, "train")
    for module, name in makers:
        monkeypatch.setattr(module, name, Mock(side_effect=AssertionError("made again")))
    chain.make(tmp_path / "work", **sizes)
