"""Exported models, and forces estimated from stores, arrays and videos."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
from command import run
from fake_model import write_model

from bench.recording import writer
from learn.checkpoint import ModelCard, read_card, write_card
from learn.cli import app
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.inference.apply import stiffness
from learn.inference.export import examples, export
from learn.inference.predict import load_model
from learn.settings import preset
from learn.training.batches import measure_scales
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.recording_flow.decode import Footage, RecordingFlowSettings
from synth.recording_flow.passes import VideoPass
from synth.system.config_file import override
from synth.video.pixel_scale import UNKNOWN_NOTE
from synth.video.read import read_video


@pytest.fixture(
    scope="module",
    params=[(), pytest.param(("arch.confidence=true", "arch.membrane=true"), marks=pytest.mark.slow)],
    ids=["plain", "confidence"],
)
def model(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    return write_model(tmp_path_factory.mktemp("model"), *request.param)


def test_an_exported_model_predicts_the_same_force_with_its_gain(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "model"
    shutil.copytree(model, folder)
    write_card(folder, replace(read_card(model), force_gain=1.25))
    plain, gained = load_model(model), load_model(folder)
    inputs = examples(plain.card, 1)
    before, after = (one.density(inputs[0].numpy(), inputs[1][0, 0].numpy(), 1.0) for one in (plain, gained))
    np.testing.assert_allclose(after, 1.25 * before, rtol=1e-5)
    assert np.abs(before).max() > 0.05 * plain.card.scales.target, "else the comparison proves nothing"
    assert export(gained, tmp_path / "net") <= 1e-4
    note = json.loads((tmp_path / "net.json").read_text())
    assert note["inputs"][:2] == ["displacement", "mask"]
    assert note["grid"]["pitch_mm"] == 36 / 32
    if len(inputs) == 2:
        session = onnxruntime.InferenceSession(str(tmp_path / "net"))
        named = {put.name: one.numpy() for put, one in zip(session.get_inputs(), inputs, strict=True)}
        np.testing.assert_allclose(session.run(None, named)[0], after, rtol=1e-3, atol=1e-5)
    monkeypatch.setattr("learn.inference.export.TOLERANCE", -1.0)
    with pytest.raises(UserError):
        export(gained, tmp_path / "refused")
    assert not list(tmp_path.glob("refused*"))


def test_predict_on_stores_and_on_arrays_agree(model: Path, dataset: Path, tmp_path: Path) -> None:
    store = sorted(dataset.glob("*.zarr"))[2]
    sequence = Dataset(dataset)[2]
    arrays = tmp_path / "mine.npz"
    np.savez(
        arrays,
        flow=sequence["flow_recovered"][:],
        confidence=sequence["flow_confidence"][:],
        tissue=sequence["tissue"][:],
        scale_mm_per_px=sequence.attrs["scale_mm_per_px"],
        young_kpa=sequence.attrs["young_kpa"],
    )
    for source in (store, arrays):
        run(app, "predict", model, source, "-o", tmp_path / "out")
    before = arrays.read_bytes()
    run(app, "predict", model, arrays, "-o", tmp_path, code=2)
    assert arrays.read_bytes() == before, "the input is not overwritten"
    with np.load(tmp_path / "out/000002.npz") as a, np.load(tmp_path / "out/mine.npz") as b:
        np.testing.assert_array_equal(a["density"], b["density"])
        assert a["force_mn"].shape == (6, 3)
        np.testing.assert_allclose(np.linalg.norm(a["force_mn"], axis=1), a["total_force_mn"], rtol=1e-6)


def write_video(file: Path, frames: int = 3) -> None:
    """Texture that slides a pixel a frame to the right, as lossless as H.264 gets."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.uniform(60, 200, (48, 80)).astype(np.float32), None, 1.5)
    wide = (255 * (wide - wide.min()) / np.ptp(wide)).clip(40, 220).astype(np.uint8)
    coloured = (wide[..., None] * np.array([1.0, 0.75, 0.7])).astype(np.uint8)
    shown = (np.ascontiguousarray(coloured[:, 8 - t : 72 - t]) for t in range(frames))
    writer.write_video(file, shown, np.arange(frames) / 10, crf=0)


def test_a_video_is_followed_and_predicted(model: Path, tmp_path: Path) -> None:
    write_video(tmp_path / "video.mp4")
    marked = np.zeros((48, 64), np.uint8)
    marked[8:40, 8:56] = 255
    cv2.imwrite(str(tmp_path / "tissue.png"), marked)
    known = ["--scale", 0.4, "--young", 1, "--tissue", tmp_path / "tissue.png"]
    run(app, "predict", model, tmp_path / "video.mp4", "-o", tmp_path, "--flow", "dis", *known)
    with np.load(tmp_path / "video.npz") as found:
        assert found["total_force_mn"].shape == (3,)
        assert found["young_known"]
        assert found["trusted"].all()
    footage = Footage(lambda: read_video(tmp_path / "video.mp4"), "video", lambda size: marked > 0)
    flows = [frame.flow for frame in VideoPass(footage, RecordingFlowSettings("dis", rate_hz=None)).frames()]
    assert np.abs(flows[0]).max() == 0
    np.testing.assert_allclose(flows[2][16:32, 16:48].mean((0, 1)), [2, 0], atol=0.3)


def test_an_unknown_scale_is_reported_and_e_ignored(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_video(tmp_path / "video.mp4", 1)
    monkeypatch.chdir(tmp_path)
    predict = ["predict", model, "video.mp4", "--flow", "dis"]
    # The picture of 64 px is assumed to be 32 mm wide.
    for name, scale in (("unknown", ["--scale", "unknown", "--young", "3"]), ("stated", ["--scale", "0.5"])):
        run(app, *predict, *scale, "--out", name)
    unknown, stated = (np.load(Path(name, "video.npz")) for name in ("unknown", "stated"))
    np.testing.assert_array_equal(unknown["total_force_mn"], stated["total_force_mn"])
    assert not unknown["young_known"]
    assert unknown["notes"][0] == UNKNOWN_NOTE
    assert UNKNOWN_NOTE not in stated["notes"]
    run(app, *predict, "--scale", -1, code=2)


def test_stiffness_from_a_press(clips: list[Clip]) -> None:
    """With a perfect model per unit stiffness E is found for any typical E."""
    clip = clips[2]
    at_rest = 0.3 * np.abs(clip.density).max() * clip.mask

    class Right:
        grid, settings = Grid(32), override(preset("tiny"), ["size=32", "arch.levels=2"])
        card = ModelCard(settings, measure_scales(clips, settings), 0.7, {}, {})

        def density(self, moved: np.ndarray, mask: object, young: float, sure: object) -> np.ndarray:
            density = clip.density if moved.any() else 0 * clip.density[: len(moved)]
            return (density + at_rest) * np.float32(young)  # not 0 without motion

    def found(force: np.ndarray) -> float:
        return stiffness(Right(), clip.displacement["ideal"], clip.mask, force)  # type: ignore[arg-type]

    force = np.linalg.norm(clip.force, axis=1)
    assert found(force) == pytest.approx(clip.young_kpa, rel=0.01)
    for wrong in (0 * force, force[1:]):
        with pytest.raises(UserError):
            found(wrong)
