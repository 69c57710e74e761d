"""Motion in three dimensions as a network's input: what a second eye's models read, refuse and say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import phantom
import pytest
import torch
from typer.testing import CliRunner

from learn import checkpoint
from learn.cli import app
from learn.data import clips as reading
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid, Scales, channels
from learn.data.split import nested
from learn.inference.export import export
from learn.inference.predict import load_predictor
from learn.network.d2fnet import Architecture
from learn.network.monai_unet import build
from learn.settings import Settings, override, preset, replace
from learn.training.batches import Frames, inputs
from learn.training.gpu_batches import Resident
from learn.training.train import train
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.flow.stereo.track import Moved

run = CliRunner().invoke
SCALES = Scales(0.5, 0.02, 0.3, 12.5, 0.07)


def small(**changes: object) -> Settings:
    base = preset("eyes")
    return replace(base, size=32, epochs=4, arch=replace(base.arch, levels=2, stem=2), **changes)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("eyes")
    for index in range(8):
        phantom.write(folder, index, anatomy_seed=index, two_eyes=True)
    return folder


@pytest.fixture(scope="module")
def told(data: Path) -> list[Clip]:
    return load_clips(data, Grid(32), ("motion-ideal", "motion"))


@pytest.fixture(scope="module")
def model(told: list[Clip], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    train(told, nested(told, 3, 0, seed=0), small(), out)
    return out


def test_motion_comes_onto_the_grid_in_millimetres_with_its_confidence(told: list[Clip]) -> None:
    clip = told[0]
    true, found = clip.displacement["motion-ideal"], clip.displacement["motion"]
    assert true.shape == (6, 3, 32, 32)
    inside = clip.mask > 0
    assert true[3, 2, inside].std() > 0.002
    assert 0.002 < (found - true)[:, :, inside].std() < 0.02, "0.02 mm of noise a pixel, over a cell's"
    sure = clip.sure("motion")
    assert sure[:, 0, inside].min() == pytest.approx(1 / (1 + 0.25), rel=1e-3)
    assert sure[:, 1, inside].max() == pytest.approx(0.5, rel=1e-3)
    assert (clip.sure("motion-ideal") == 1).all()
    assert clip.sure("motion-ideal").shape == sure.shape


def test_packed_motion_is_what_was_read(told: list[Clip], tmp_path: Path) -> None:
    reading.pack(told[0], tmp_path / "clip")
    again = reading.unpack(tmp_path / "clip")
    np.testing.assert_array_equal(again.displacement["motion"], told[0].displacement["motion"])
    np.testing.assert_array_equal(again.sure("motion"), told[0].sure("motion"))
    (tmp_path / "clip/arrays.safetensors").unlink()
    with pytest.raises(UserError, match="damaged packed sequence"):
        reading.unpack(tmp_path / "clip")


def test_one_eyes_dataset_is_refused_in_a_line(tmp_path: Path) -> None:
    phantom.write(tmp_path / "one", 0, anatomy_seed=0)
    with pytest.raises(UserError, match=r"no motion of two eyes .field motion_recovered.; .*stereo_mm"):
        load_clips(tmp_path / "one", Grid(32), ("motion",))
    said = run(app, ["train", str(tmp_path / "one"), "-o", str(tmp_path / "m"), "--input", "motion"])
    assert isinstance(said.exception, (UserError, SystemExit))
    assert not (tmp_path / "m").exists()


def test_channels_of_two_eyes_are_those_of_one_and_two_more() -> None:
    rng = np.random.default_rng(0)
    moved = torch.from_numpy(rng.normal(size=(2, 3, 32, 32)).astype(np.float32))
    mask = torch.ones(2, 1, 32, 32)
    sure = torch.rand(2, 2, 32, 32)
    one = channels(moved[:, :2], mask, 1.0, SCALES, sure[:, :1])
    two = channels(moved, mask, 1.0, SCALES, sure)
    assert torch.equal(two[:, :6], one)
    assert torch.equal(two[:, 6], moved[:, 2] / SCALES.displacement_mm)
    assert torch.equal(two[:, 7], sure[:, 1])
    assert channels(moved, mask, 1.0, SCALES).shape[1] == 6


def test_depth_stays_when_the_picture_turns(told: list[Clip]) -> None:
    frames = Frames(told, small())
    still = frames.batch([(0, 3, "motion", 0)])
    for turn in range(8):
        turned = frames.batch([(0, 3, "motion", turn)])
        for name in ("displacement", "confidence", "target"):
            sizes = [getattr(one, name)[:, -1].flatten().sort().values for one in (still, turned)]
            assert torch.equal(*sizes), (turn, name)
        # Both confidences are numbers, not a vector's components.
        assert torch.equal(
            turned.confidence.flatten(2).sort().values, still.confidence.flatten(2).sort().values
        )


def test_frames_held_by_a_device_are_those_read_one_by_one(told: list[Clip]) -> None:
    settings = small()
    items = [(c, t, source, c) for c in range(8) for t in (1, 4) for source in ("motion", "motion-ideal")]
    read, held = Frames(told, settings), Resident(told, settings, torch.device("cpu"))
    for item in items:
        one, other = read.batch([item]), held.batch([item])
        for name in vars(one):
            assert torch.equal(getattr(one, name), getattr(other, name)), (item, name)
    assert inputs(read.batch(items), settings, SCALES).shape[1] == 8


def test_a_model_of_two_eyes_says_so_and_reads_nothing_else(
    model: Path, told: list[Clip], data: Path
) -> None:
    card = checkpoint.read_card(model)
    assert card.settings.arch.depth
    assert card.settings.input == "motion-mixed"
    assert build(card.settings.arch)(torch.zeros(1, 8, 32, 32)).shape == (1, 3, 32, 32)
    predictor = load_predictor(model)
    clip = told[0]
    with pytest.raises(UserError, match=r"\(T, 3, 32, 32\) \[dx, dy, dz"):
        predictor.density(clip.displacement["motion"][:, :2], clip.mask, 1.0)
    tissue = np.ones((48, 64), bool)
    flow = np.zeros((48, 64, 2), np.float32)
    with pytest.raises(UserError, match="second eye"):
        predictor(flow, tissue, 0.5)
    still = Moved(np.zeros((48, 64, 3), np.float32), np.zeros((48, 64, 3), np.float32))
    assert predictor(flow, tissue, 0.5, moved=still).force_mn is not None
    with pytest.raises(UserError, match=r"its deviation: expected \(48, 64, 3\)"):
        predictor(flow, tissue, 0.5, moved=Moved(still.motion, still.deviation[..., :2]))
    with pytest.raises(UserError, match="can't read input 'recovered'"):
        predictor.stored("recovered")
    assert predictor.stored(None) == "motion"


def test_the_seal_holds_the_input(model: Path, tmp_path: Path) -> None:
    tree = json.loads((model / "config.json").read_text())
    assert tree["settings"]["arch"]["depth"] is True
    tree["settings"]["input"] = "motion"
    (tmp_path / "config.json").write_text(json.dumps(tree))
    with pytest.raises(UserError, match="not as it was written"):
        checkpoint.read_card(tmp_path)


def test_one_eyes_cards_are_written_as_before() -> None:
    assert "depth" not in Architecture().model_dump()
    assert Architecture(depth=True).model_dump()["depth"] is True
    assert Architecture.model_validate(Architecture(depth=True).model_dump()).depth


def test_input_and_architecture_go_together() -> None:
    with pytest.raises(UserError, match=r"goes with arch.depth true"):
        override(preset("cpu"), ["input=motion"])
    with pytest.raises(UserError, match=r"goes with arch.depth false"):
        override(preset("eyes"), ["input=recovered"])


@pytest.mark.slow
def test_predict_eval_export_and_a_foreign_array(
    model: Path, data: Path, told: list[Clip], tmp_path: Path
) -> None:
    said = run(app, ["predict", str(model), str(data), "-o", str(tmp_path / "f"), "--json"])
    assert said.exit_code == 0, said.output
    stored = np.load(tmp_path / "f/000000.npz")
    assert stored["force_mn"].shape == (6, 3)
    # The same motion as arrays from elsewhere.
    sequence = Dataset(data)[0]
    np.savez(
        tmp_path / "given.npz",
        motion=sequence["motion_recovered"][:],
        deviation=sequence["motion_deviation"][:],
        tissue=sequence["tissue"][:],
        scale_mm_per_px=0.5,
        young_kpa=sequence.attrs["young_kpa"],
    )
    assert (
        run(app, ["predict", str(model), str(tmp_path / "given.npz"), "-o", str(tmp_path / "g")]).exit_code
        == 0
    )
    np.testing.assert_allclose(
        np.load(tmp_path / "g/given.npz")["force_mn"], stored["force_mn"], rtol=1e-4, atol=1e-4
    )
    scored = run(app, ["eval", str(model), str(data), "--all", "--json"])
    assert scored.exit_code == 0, scored.output
    assert json.loads(scored.stdout)["input"] == "motion"
    assert run(app, ["eval", str(model), str(data), "--all", "--input", "recovered"]).exit_code != 0
    assert export(load_predictor(model), tmp_path / "net.pt", "torchscript") < 1e-4
    about = json.loads((tmp_path / "net.pt.json").read_text())
    assert "second eye" in about["preprocessing"][0]
