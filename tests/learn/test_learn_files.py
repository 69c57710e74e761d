"""What leaves the room: exported models, forces of files, settings from the command line."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import phantom
import pytest
import torch
from typer.testing import CliRunner

from learn.apply import motions
from learn.batch import measure_scales
from learn.checkpoint import Card, save_tensors, write_card
from learn.cli import app
from learn.data import Clip
from learn.export import examples, export
from learn.model import D2FNet
from learn.predict import load as load_model
from learn.settings import override, preset
from synth.errors import UserError
from synth.store import Dataset

run = CliRunner().invoke


@pytest.fixture(scope="module", params=["plain", "everything"])
def model(
    clips: list[Clip], tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Path:
    """An untrained network with weights large enough to say something."""
    extra = ["arch.confidence=true", "arch.condition=film"] if request.param == "everything" else []
    settings = override(preset("tiny"), ["size=32", "arch.levels=2", *extra])
    out = tmp_path_factory.mktemp("model")
    torch.manual_seed(0)
    net = D2FNet(settings.arch).eval()
    with torch.no_grad():
        for conv in net.heads.ranges:  # type: ignore[union-attr]
            conv.weight.normal_(0, 200.0)  # type: ignore[union-attr,operator]
        if net.film is not None:
            net.film.weight.normal_(0, 0.2)
    write_card(out, Card(settings, measure_scales(clips, settings), 1.2, {}, {}))
    save_tensors(out / "weights.pt", net.state_dict())
    return out


@pytest.mark.parametrize("kind", ["torchscript", "onnx"])
def test_an_exported_model_says_the_same(model: Path, tmp_path: Path, kind: str) -> None:
    predictor = load_model(model)
    file = tmp_path / "net"
    worst = export(predictor, file, kind)
    said = predictor.density(
        examples(predictor.card, 1)[0].numpy(), examples(predictor.card, 1)[1][0, 0].numpy(), 1.0
    )
    assert np.abs(said).max() > 0.05 * predictor.card.scales.target, "a silent network proves nothing"
    assert worst <= 1e-4
    note = json.loads((tmp_path / "net.json").read_text())
    assert note["inputs"][:2] == ["displacement", "mask"]
    assert note["grid"]["pitch_mm"] == 36 / 32


def test_an_unfaithful_export_is_refused_and_removed(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("learn.export.TOLERANCE", -1.0)
    with pytest.raises(UserError, match="differs from PyTorch"):
        export(load_model(model), tmp_path / "net", "torchscript")
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match="unknown format 'tflite'"):
        export(load_model(model), tmp_path / "net", "tflite")


def test_predict_on_stores_and_on_arrays_agree(model: Path, dataset: Path, tmp_path: Path) -> None:
    store = sorted(dataset.glob("*.zarr"))[2]
    sequence = Dataset(dataset)[2]
    arrays = tmp_path / "mine.npz"
    np.savez(
        arrays,
        flow=sequence["flow_tvl1"][:],
        confidence=sequence["flow_confidence"][:],
        tissue=sequence["tissue"][:],
        scale_mm_per_px=sequence.attrs["scale_mm_per_px"],
        young_kpa=sequence.attrs["young_kpa"],
    )
    for source in (store, arrays):
        done = run(app, ["predict", str(model), str(source), "-o", str(tmp_path / "out"), "--json"])
        assert done.exit_code == 0, done.output
    with np.load(tmp_path / "out/000002.npz") as a, np.load(tmp_path / "out/mine.npz") as b:
        np.testing.assert_array_equal(a["density"], b["density"])
        assert a["force_mn"].shape == (6, 3)
        np.testing.assert_allclose(np.linalg.norm(a["force_mn"], axis=1), a["total_force_mn"], rtol=1e-6)


def test_bad_files(tmp_path: Path, dataset: Path) -> None:
    def first(path: Path) -> None:
        next(iter(motions(path, "recovered")))

    np.savez(tmp_path / "a.npz", flow=np.zeros((2, 4, 4, 2)))
    np.savez(tmp_path / "b.npz", flow=np.zeros((2, 4, 4, 2)), tissue=np.ones((4, 5)), scale_mm_per_px=0.1)
    (tmp_path / "c.npz").write_bytes(b"PK no")
    for name, message in (
        ("a.npz", "lacks scale_mm_per_px, tissue"),
        ("b.npz", r"flow is \(2, 4, 4, 2\)"),
        ("c.npz", "cannot be read"),
        ("d.mp4", "bench score"),
        ("e.zarr", "no such sequence"),
    ):
        with pytest.raises(UserError, match=message):
            first(tmp_path / name)
    phantom.write(tmp_path / "x", 0, anatomy_seed=0, recovered=False)
    with pytest.raises(UserError, match="holds no recovered flow"):
        first(tmp_path / "x")


def test_settings_from_words() -> None:
    got = override(
        preset("tiny"), ["arch.width=8", "batch=3", "augment=false", "arch.bounds=1,2,3", "objective.low=0.1"]
    )
    assert (got.arch.width, got.batch, got.augment, got.arch.bounds) == (8, 3, False, (1.0, 2.0, 3.0))
    assert got.objective.low == 0.1
    assert dataclasses.replace(got, batch=8).arch.stem == preset("tiny").arch.stem


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("bacth=3", r"bacth=3: unknown setting, did you mean 'batch'"),
        ("arch.widht=3", r"did you mean 'arch.width'"),
        ("batch=many", "not a value of type int"),
        ("augment=1", "not a value of type bool"),
        ("arch=3", "unknown setting"),
        ("batch=0", "batch 0: must be positive"),
        ("schedule=step", "unknown schedule 'step'"),
    ],
)
def test_settings_that_cannot_be(change: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        override(preset("tiny"), [change])
