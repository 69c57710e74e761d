"""The chain that trains all weights below the force, in small."""

import hashlib
import json
from pathlib import Path
from unittest.mock import Mock

import pytest

from evidence import weights
from evidence.flow import correction_training, segmentation_training
from synth.flow import correction, segmentation
from synth.flow.stereo import depth_correction


@pytest.mark.slow
@pytest.mark.trial
def test_weights_are_made_from_nothing_and_cards_name_those_below(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    how = {"randomized": 1, "mission": 1, "drawn": 4, "steps": 2, "minutes": 0.02}
    for part in (segmentation, correction, depth_correction):
        monkeypatch.setattr(part, "WEIGHTS", part.WEIGHTS)  # set back afterwards
    weights.measure(tmp_path / "work", **how)
    cards = {file.stem: json.loads(file.read_text()) for file in (tmp_path / "work/made").glob("*.json")}
    assert cards["segmentation"]["below"] == {}
    first = hashlib.sha256((tmp_path / "work/made/segmentation.onnx").read_bytes()).hexdigest()
    assert first.startswith(cards["depth_correction"]["below"]["segmentation"])
    assert set(cards["depth_correction"]["below"]) == {"segmentation", "correction"}
    makers = (weights, "_rendered"), (segmentation_training, "train"), (correction_training, "train")
    for module, name in makers:
        monkeypatch.setattr(module, name, Mock(side_effect=AssertionError("made again")))
    weights.measure(tmp_path / "work", **how)
