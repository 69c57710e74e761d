"""Exported models, and forces estimated from stores, arrays and videos, with the files that hold them."""

import csv
import json
import runpy
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import fake_intervals
import numpy as np
import onnxruntime
import pytest
from command import run
from fake_model import write_model

import learn
from bench.recording import recording_writer
from learn.checkpoint import ModelCard, read_card, write_card
from learn.cli import app
from learn.data.clips import Clip
from learn.data.grid import Grid, GridView, to_image
from learn.inference import prediction_file
from learn.inference.apply import apply, stiffness
from learn.inference.convert import examples
from learn.inference.export import export
from learn.inference.predict import load_model
from learn.inference.shipped_networks import MODELS
from learn.inference.video_motion import motions
from learn.settings import preset
from learn.training.batches import measure_scales
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.flow.estimator import name_motion
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.video_pass import VideoPass
from synth.system.checked_file import write_picture
from synth.system.config_file import override
from synth.video.pixel_scale import UNKNOWN_NOTE
from synth.video.read_video import read_video


@pytest.fixture(
    scope="module",
    params=[(), pytest.param(("arch.confidence=true", "arch.membrane=true"), marks=pytest.mark.slow)],
    ids=["plain", "confidence"],
)
def model(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    return write_model(tmp_path_factory.mktemp("model"), *request.param)


@pytest.mark.parametrize(
    "changes",
    [
        {"force_gain": 1e308},
        {"force_gain": 1e-300},
        {"typical_young_kpa": 1e308},
        {"scales": {"target": 1e200}},
    ],
)
def test_a_card_with_an_absurd_number_is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    """Its seal matches: whoever made it meant it."""
    card = read_card(MODELS / "stereo")
    scales = replace(card.scales, **changes.pop("scales", {}))
    write_card(tmp_path / "model", replace(card, **changes, scales=scales))
    with pytest.raises(UserError, match="must be from"):
        read_card(tmp_path / "model")


def test_an_exported_model_predicts_the_same_force_with_its_gain(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "model"
    shutil.copytree(model, folder)
    write_card(folder, replace(read_card(model), force_gain=1.25))
    plain, adjusted = load_model(model), load_model(folder)
    inputs = examples(plain.card, 1)
    before, after = (
        network.density(inputs[0].numpy(), inputs[1][0, 0].numpy(), 1.0) for network in (plain, adjusted)
    )
    np.testing.assert_allclose(after, 1.25 * before, rtol=1e-5)
    assert np.abs(before).max() > 0.05 * plain.card.scales.target, "else the comparison proves nothing"
    assert export(folder, tmp_path / "net") <= 1e-4
    note = json.loads((tmp_path / "net.json").read_text())
    assert note["inputs"][:2] == ["displacement", "mask"]
    assert note["grid"]["pitch_mm"] == 36 / 32
    if len(inputs) == 2:
        session = onnxruntime.InferenceSession(str(tmp_path / "net"))
        named = {put.name: tensor.numpy() for put, tensor in zip(session.get_inputs(), inputs, strict=True)}
        np.testing.assert_allclose(session.run(None, named)[0], after, rtol=1e-3, atol=1e-5)
    namespace = runpy.run_path(str(tmp_path / "net.example.py"))
    displacement, confidence = namespace["inputs"]["displacement"], namespace["inputs"].get("confidence")
    density = adjusted.density(
        displacement, np.ones((32, 32), np.float32), plain.card.typical_young_kpa, confidence
    )
    force = (36 / 32) ** 2 * density[0].sum(axis=(1, 2))
    np.testing.assert_allclose(namespace["force_mn"], force, rtol=1e-3, atol=1e-4)
    monkeypatch.setattr("learn.inference.convert.TOLERANCE", -1.0)
    with pytest.raises(UserError):
        export(folder, tmp_path / "refused")
    assert not list(tmp_path.glob("refused*"))


def test_predict_on_stores_and_on_arrays_agree(model: Path, dataset: Path, tmp_path: Path) -> None:
    store = sorted(dataset.glob("*.zarr"))[2]
    sequence = Dataset(dataset)[2]
    arrays = tmp_path / "mine.npz"
    fields = {"flow": "flow_recovered", "confidence": "flow_confidence", "tissue": "tissue"}
    constants = {name: sequence.attrs[name] for name in ("scale_mm_per_px", "young_kpa")}
    np.savez(arrays, **{name: sequence[field][:] for name, field in fields.items()}, **constants)
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
    texture = cv2.GaussianBlur(rng.uniform(60, 200, (48, 80)).astype(np.float32), None, 1.5)
    texture = (255 * (texture - texture.min()) / np.ptp(texture)).clip(40, 220).astype(np.uint8)
    rgb = (texture[..., None] * np.array([1.0, 0.75, 0.7])).astype(np.uint8)
    pictures = (np.ascontiguousarray(rgb[:, 8 - t : 72 - t]) for t in range(frames))
    recording_writer.write_video(file, pictures, np.arange(frames) / 10, crf=0)


def test_a_video_is_followed_and_predicted(model: Path, tmp_path: Path) -> None:
    write_video(tmp_path / "video.mp4")
    tissue = np.zeros((48, 64), np.uint8)
    tissue[8:40, 8:56] = 255
    cv2.imwrite(str(tmp_path / "tissue.png"), tissue)
    options = ["--scale", 0.4, "--young", 1, "--tissue", tmp_path / "tissue.png"]
    run(app, "predict", model, tmp_path / "video.mp4", "-o", tmp_path, "--flow", "dis", *options)
    with np.load(tmp_path / "video.npz") as prediction:
        assert prediction["total_force_mn"].shape == (3,)
        assert prediction["young_known"]
        assert prediction["trusted"].all()
    footage = Footage(lambda: read_video(tmp_path / "video.mp4"), "video", lambda size: tissue > 0)
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
    with np.load("unknown/video.npz") as unknown_arrays, np.load("stated/video.npz") as stated_arrays:
        np.testing.assert_array_equal(unknown_arrays["total_force_mn"], stated_arrays["total_force_mn"])
        assert not unknown_arrays["young_known"]
        assert UNKNOWN_NOTE in unknown_arrays["notes"]
        assert UNKNOWN_NOTE not in stated_arrays["notes"]
    run(app, *predict, "--scale", -1, code=2)


def test_stiffness_from_a_press(clips: list[Clip]) -> None:
    """With a perfect model per unit stiffness E is found for any typical E."""
    clip = clips[2]
    at_rest = 0.3 * np.abs(clip.density).max() * clip.mask

    class Right:
        grid, settings = Grid(32), override(preset("tiny"), ["size=32", "arch.levels=2"])
        card = ModelCard(settings, measure_scales(clips, settings), 0.7, {}, {})

        def density(
            self, displacement: np.ndarray, mask: object, young: float, confidence: object
        ) -> np.ndarray:
            density = clip.density if displacement.any() else 0 * clip.density[: len(displacement)]
            return (density + at_rest) * np.float32(young)  # not 0 without motion

    def fit_young(force: np.ndarray) -> float:
        return stiffness(Right(), clip.displacement["ideal"], clip.mask, force)  # type: ignore[arg-type]

    force = np.linalg.norm(clip.force, axis=1)
    assert fit_young(force) == pytest.approx(clip.young_kpa, rel=0.01)
    for bad_force in (0 * force, force[1:]):
        with pytest.raises(UserError):
            fit_young(bad_force)


@pytest.fixture(scope="module")
def vector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"), "arch.output=vector")


def test_a_dataset_gives_the_three_files(dataset: Path, vector: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset / "000000.zarr", tmp_path / "data/000000.zarr")
    result = run(app, "predict", vector, tmp_path / "data", "--out", tmp_path)
    assert str(tmp_path / "000000.force.csv") in result.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["000000.force.csv", "000000.force.mp4", "000000.npz", "data"]
    sequence = Dataset(dataset)[0]
    with np.load(tmp_path / "000000.npz") as prediction:
        assert set(prediction.files) <= set(prediction_file.FIELDS)
        assert prediction["scale_mm_per_px"] == pytest.approx(sequence.attrs["scale_mm_per_px"])
        rows = list(csv.DictReader((tmp_path / "000000.force.csv").read_text().splitlines()))
        assert tuple(rows[0]) == prediction_file.COLUMNS
        columns = {"total_force_mn": prediction["total_force_mn"], "force_y_mn": prediction["force_mn"][:, 1]}
        for name, values in (columns | {"time_s": sequence["time"][:]}).items():
            assert [float(row[name]) for row in rows] == pytest.approx(values, rel=1e-5), name
    overlay = list(read_video(tmp_path / "000000.force.mp4"))
    assert len(overlay) == sequence.frames
    assert overlay[0].rgb.shape[0] > sequence.size[0], "the curve lies below the picture"


@pytest.mark.slow
def test_an_array_gives_what_its_pictures_give(dataset: Path, vector: Path, tmp_path: Path) -> None:
    sequence = Dataset(dataset)[0]
    rgb, tissue = sequence["rgb"][:], sequence["tissue"][:]
    (tmp_path / "frames").mkdir()
    for t, picture in enumerate(rgb):
        write_picture(tmp_path / "frames" / f"{t:03d}.png", picture)
    write_picture(tmp_path / "tissue.png", np.uint8(255) * tissue)
    options: dict[str, Any] = {"scale_mm_per_px": 0.3, "young_kpa": 1.5, "rate_hz": None, "flow": "dis"}
    from_files = learn.predict(
        tmp_path / "frames", vector, tissue=tmp_path / "tissue.png", masks="none", **options
    )
    from_array = learn.predict(rgb, str(vector), tissue=tissue, masks="none", fps=25, **options)
    np.testing.assert_array_equal(from_array["force_mn"], from_files["force_mn"])
    np.testing.assert_array_equal(from_array["time_s"], from_files["time_s"])
    with_masks = learn.predict(rgb, vector, tissue=tissue, masks=sequence["tool"][:], fps=25, **options)
    assert with_masks["trusted"].all()
    for change in ({"tissue": tissue[1:]}, {"masks": sequence["tool"][:2]}, {"membrane": "gone"}):
        with pytest.raises(UserError, match=next(iter(change))):
            learn.predict(rgb, vector, **{"tissue": tissue, **options, **change})


def test_motion_by_another_estimator_than_the_networks_own_is_noted(dataset: Path, tmp_path: Path) -> None:
    model_folder = write_model(tmp_path / "model", "arch.output=vector")
    write_card(
        model_folder,
        card := replace(
            read_card(model_folder), motion=[name_motion("dis")], intervals=fake_intervals.make()
        ),
    )
    rgb, options = Dataset(dataset)[0]["rgb"][:], {"scale_mm_per_px": 0.3, "masks": "none"}
    predictions = {name: learn.predict(rgb, model_folder, flow=name, **options) for name in ("dis", "tvl1")}
    (doubt,) = card.doubt(name_motion("tvl1"))
    assert doubt not in predictions["dis"]["notes"]
    assert doubt == predictions["tvl1"]["notes"][0]
    assert ["level" in prediction for prediction in predictions.values()] == [True, False]


def test_the_drawn_map_is_the_inverse_of_the_resampling_to_the_grid(dataset: Path, vector: Path) -> None:
    (motion,) = motions(dataset / "000000.zarr", "ideal")
    predictor = load_model(vector)
    prediction = apply(predictor, motion)
    view = GridView(motion.tissue, motion.scale_mm_per_px, predictor.grid)
    n = predictor.grid.size
    cells = np.exp(-((np.arange(n)[:, None] - 0.6 * n) ** 2 + (np.arange(n) - 0.4 * n) ** 2) / 20)
    place = prediction["centres_px"][2], float(prediction["scale_mm_per_px"]), float(prediction["pitch_mm"])
    image = to_image(cells, motion.tissue.shape, *place)
    everywhere = np.ones_like(motion.tissue)
    back = GridView(everywhere, motion.scale_mm_per_px, predictor.grid, view.centre_px).mean(image)
    assert np.abs(back - cells)[view.mask > 0].max() < 0.1
    row, column = (np.average(axis, weights=image) for axis in np.indices(image.shape))
    x, y = prediction["centres_px"][2]
    step = prediction["pitch_mm"] / prediction["scale_mm_per_px"]
    assert column == pytest.approx(x + (0.4 * n - (n - 1) / 2) * step, abs=1.0)
    assert row == pytest.approx(y + (0.6 * n - (n - 1) / 2) * step, abs=1.0)
