"""What leaves the room: exported models, forces of files, settings from the command line."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import onnxruntime
import phantom
import pytest
import torch
from typer.testing import CliRunner

from learn.checkpoint import Card, read_card, write_card, write_model
from learn.cli import app
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.inference import apply
from learn.inference.apply import Filmed, motions
from learn.inference.export import examples, export
from learn.inference.predict import load_predictor
from learn.inference.pulse import Pulse, Rhythm
from learn.inference.scale import UNKNOWN_NOTE
from learn.inference.stiffness import stiffness
from learn.inference.video import read_video
from learn.inference.video_flow import Footage, Settings, VideoFlow
from learn.network.d2fnet import D2FNet
from learn.network.monai_unet import build
from learn.settings import override, preset
from learn.training.batches import measure_scales
from synth.dataset.store import Dataset
from synth.errors import UserError

run = CliRunner().invoke


@pytest.fixture(scope="module", params=["plain", pytest.param("everything", marks=pytest.mark.slow), "monai"])
def model(
    clips: list[Clip], tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Path:
    """An untrained network with weights large enough to say something."""
    extra = {
        "plain": [],
        "everything": ["arch.confidence=true", "arch.condition=film", "arch.total=true"],
        "monai": ["arch.name=monai-unet", "arch.stem=1"],
    }[request.param]
    settings = override(preset("tiny"), ["size=32", "arch.levels=2", *extra])
    out = tmp_path_factory.mktemp("model")
    torch.manual_seed(0)
    net = build(settings.arch).eval()
    with torch.no_grad():
        if isinstance(net, D2FNet):
            for conv in net.heads.ranges:  # type: ignore[union-attr]
                conv.weight.normal_(0, 200.0)  # type: ignore[union-attr,operator]
        if isinstance(net, D2FNet) and net.film is not None:
            net.film.weight.normal_(0, 0.2)
    write_model(out, Card(settings, measure_scales(clips, settings), 1.2, {}, {}), net.state_dict())
    return out


@pytest.mark.parametrize("kind", ["torchscript", "onnx"])
def test_an_exported_model_says_the_same(model: Path, tmp_path: Path, kind: str) -> None:
    predictor = load_predictor(model)
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


def test_the_gain_is_in_every_map(model: Path, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    shutil.copytree(model, folder)
    write_card(folder, replace(read_card(model), force_gain=1.25))
    plain, gained = load_predictor(model), load_predictor(folder)
    told = examples(plain.card, 1)
    before, after = (one.density(told[0].numpy(), told[1][0, 0].numpy(), 1.0) for one in (plain, gained))
    np.testing.assert_allclose(after, 1.25 * before, rtol=1e-5)
    if len(told) == 2:  # the others are told more than `density` here
        export(gained, tmp_path / "net", "onnx")
        session = onnxruntime.InferenceSession(str(tmp_path / "net"))
        named = {asked.name: one.numpy() for asked, one in zip(session.get_inputs(), told, strict=True)}
        np.testing.assert_allclose(session.run(None, named)[0], after, rtol=1e-3, atol=1e-6)


def test_an_unfaithful_export_is_refused_and_removed(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("learn.inference.export.TOLERANCE", -1.0)
    with pytest.raises(UserError, match="differs from PyTorch"):
        export(load_predictor(model), tmp_path / "net", "torchscript")
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match="unknown format 'tflite'"):
        export(load_predictor(model), tmp_path / "net", "tflite")


def test_predict_never_writes_over_what_it_reads(model: Path, dataset: Path, tmp_path: Path) -> None:
    sequence = Dataset(dataset)[2]
    mine = tmp_path / "mine.npz"
    np.savez(mine, flow=sequence["flow"][:], tissue=sequence["tissue"][:], scale_mm_per_px=0.5)
    before = mine.read_bytes()
    done = run(app, ["predict", str(model), str(mine), "-o", str(tmp_path)])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1), done.output
    assert "would be overwritten" in done.stderr
    assert mine.read_bytes() == before


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
        done = run(app, ["predict", str(model), str(source), "-o", str(tmp_path / "out"), "--json"])
        assert done.exit_code == 0, done.output
    with np.load(tmp_path / "out/000002.npz") as a, np.load(tmp_path / "out/mine.npz") as b:
        np.testing.assert_array_equal(a["density"], b["density"])
        assert a["force_mn"].shape == (6, 3)
        np.testing.assert_allclose(np.linalg.norm(a["force_mn"], axis=1), a["total_force_mn"], rtol=1e-6)


def write_film(file: Path, frames: int = 3) -> None:
    """Texture that slides a pixel a frame to the right, as lossless as H.264 gets."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.uniform(60, 200, (48, 80)).astype(np.float32), None, 1.5)
    wide = (255 * (wide - wide.min()) / np.ptp(wide)).clip(40, 220).astype(np.uint8)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "0", "threads": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p"
        for t in range(frames):
            rgb = np.repeat(wide[:, 8 - t : 72 - t, None], 3, axis=2) * np.array([1.0, 0.75, 0.7])
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb.astype(np.uint8)), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_a_video_is_followed_and_predicted(model: Path, tmp_path: Path) -> None:
    write_film(tmp_path / "film.mp4")
    marked = np.zeros((48, 64), np.uint8)
    marked[8:40, 8:56] = 255
    cv2.imwrite(str(tmp_path / "tissue.png"), marked)
    args = ["predict", str(model), str(tmp_path / "film.mp4"), "-o", str(tmp_path), "--scale", "0.4"]
    done = run(
        app, [*args, "--tissue", str(tmp_path / "tissue.png"), "--flow", "dis", "--young", "1", "--json"]
    )
    assert done.exit_code == 0, done.output
    with np.load(tmp_path / "film.npz") as found:
        assert found["total_force_mn"].shape == (3,)
        assert found["young_known"]
        assert found["trusted"].all()
    (tmp_path / "tools").mkdir()
    cv2.imwrite(str(tmp_path / "tools" / "mask.png"), np.full((48, 64), 255, np.uint8))
    assert run(app, [*args, "--masks", str(tmp_path / "tools"), "--flow", "dis"]).exit_code == 0
    with np.load(tmp_path / "film.npz") as found:
        assert found["trusted"].tolist() == [True, False, False]
    footage = Footage(read_video(tmp_path / "film.mp4"), "film", lambda size: marked > 0)
    seen = [step.found.flow for step in VideoFlow(footage, Settings("dis", rate_hz=None)).steps()]
    assert np.abs(seen[0]).max() == 0
    np.testing.assert_allclose(seen[2][16:32, 16:48].mean((0, 1)), [2, 0], atol=0.3)


def test_an_unknown_scale_is_said_and_takes_e_with_it(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_film(tmp_path / "film.mp4", 1)
    monkeypatch.chdir(tmp_path)
    film = ["predict", str(model), "film.mp4", "--flow", "dis"]
    # A picture of 64 px taken to be 32 mm wide; E is of no use.
    for name, asked in (("asked", ["--scale", "unknown", "--young", "3"]), ("as", ["--scale", "0.5"])):
        done = run(app, [*film, *asked, "--out", name])
        assert done.exit_code == 0, done.output
    unknown, stated = (np.load(Path(name, "film.npz")) for name in ("asked", "as"))
    np.testing.assert_array_equal(unknown["total_force_mn"], stated["total_force_mn"])
    assert not unknown["young_known"]
    assert unknown["notes"][0] == UNKNOWN_NOTE
    assert UNKNOWN_NOTE not in stated["notes"]
    assert "or unknown" in run(app, [*film, "--scale", "-1"]).output


def test_a_pulse_that_was_taken_off_is_said_once(tmp_path: Path) -> None:
    write_film(tmp_path / "film.mp4", 1)
    beat = Rhythm(1.2, np.zeros(1), np.zeros(1), np.zeros((2, 1, 2)))
    found = Pulse(
        (beat,),
        np.zeros((48, 64, 1), np.float32),
        np.zeros((1, 2)),
        np.zeros((48, 64, 2), np.float32),
        (0.5,),
        1.0,
    )
    notes = " ".join(apply._video(tmp_path / "film.mp4", Filmed(0.1), found).notes())
    assert notes.count("the whole surface moves by itself") == notes.count("taken off") == 1


def test_films_that_are_none(tmp_path: Path) -> None:
    write_film(tmp_path / "film.mp4", 1)
    (tmp_path / "torn.mp4").write_bytes(b"no film")
    cv2.imwrite(str(tmp_path / "small.png"), np.full((4, 4), 255, np.uint8))
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((48, 64), np.uint8))
    for name, mask, message in (
        ("torn.mp4", None, "not a readable video"),
        ("film.mp4", "small.png", "4 x 4, the video is 64 x 48"),
        ("film.mp4", "black.png", "marks no tissue"),
        ("film.mp4", "missing.png", "no such file"),
    ):
        with pytest.raises(UserError, match=message):
            next(motions(tmp_path / name, "recovered", Filmed(0.1, tmp_path / mask if mask else None)))


def test_stiffness_from_a_press(clips: list[Clip], dataset: Path, tmp_path: Path) -> None:
    """A model that is right per unit stiffness finds E, whatever E it starts from; film or not."""
    clip = clips[2]
    at_rest = 0.3 * np.abs(clip.density).max() * clip.mask

    class Right:
        grid = Grid(32)

        def __init__(self, condition: str, exponent: float) -> None:
            settings = override(preset("tiny"), ["size=32", "arch.levels=2", f"arch.condition={condition}"])
            self.card, self.exponent = Card(settings, measure_scales(clips, settings), 0.7, {}, {}), exponent

        def density(self, moved: np.ndarray, mask: object, young: float, sure: object) -> np.ndarray:
            # A conditioned network may lean on E; it is right where E is. Its answer to no motion is not 0.
            said = clip.density if moved.any() else 0 * clip.density[: len(moved)]
            return (said + at_rest) * np.float32(young * (young / clip.young_kpa) ** self.exponent)

    force = np.linalg.norm(clip.force, axis=1)
    for right in (Right("none", 0.0), Right("film", -0.3)):
        found = stiffness(right, clip.displacement["ideal"], clip.mask, force)  # type: ignore[arg-type]
        assert found == pytest.approx(clip.young_kpa, rel=0.01)
    with pytest.raises(UserError, match="no force was given"):
        stiffness(right, clip.displacement["ideal"], clip.mask, 0 * force)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="5 forces for 6 frames"):
        stiffness(right, clip.displacement["ideal"], clip.mask, force[1:])  # type: ignore[arg-type]


def test_calibrate_command(model: Path, dataset: Path, tmp_path: Path) -> None:
    store = sorted(dataset.glob("*.zarr"))[2]
    done = run(app, ["calibrate", str(model), str(store), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["young_kpa"]["000002"] > 0
    sequence = Dataset(dataset)[2]
    keep = {k: sequence[k][:] for k in ("flow", "tissue")}
    np.savez(tmp_path / "a.npz", scale_mm_per_px=0.5, **keep)
    done = run(app, ["calibrate", str(model), str(tmp_path / "a.npz")])
    assert done.exit_code == 2
    assert "a: holds no force to calibrate on" in done.stderr


def test_bad_files(tmp_path: Path, dataset: Path) -> None:
    def first(path: Path) -> None:
        next(iter(motions(path, "recovered")))

    np.savez(tmp_path / "a.npz", flow=np.zeros((2, 4, 4, 2)))
    np.savez(tmp_path / "b.npz", flow=np.zeros((2, 4, 4, 2)), tissue=np.ones((4, 5)), scale_mm_per_px=0.1)
    (tmp_path / "c.npz").write_bytes(b"PK no")
    flow, tissue = np.zeros((2, 4, 4, 2)), np.ones((4, 4))
    np.savez(tmp_path / "g.npz", flow=flow, tissue=np.ones((2, 4, 4)), scale_mm_per_px=0.1)
    np.savez(tmp_path / "h.npz", flow=flow, tissue=tissue, scale_mm_per_px=[0.1, 0.1])
    np.savez(tmp_path / "i.npz", flow=flow[:0], tissue=tissue, scale_mm_per_px=0.1)
    np.savez(tmp_path / "j.npz", flow=flow, tissue=tissue, scale_mm_per_px=0.1, young_kpa=np.nan)
    np.savez(tmp_path / "k.npz", flow=flow, tissue=tissue, scale_mm_per_px="wide")
    np.save(tmp_path / "l.npy", flow)
    (tmp_path / "l.npy").rename(tmp_path / "l.npz")
    os.mkfifo(tmp_path / "m.npz")
    for name, message in (
        ("a.npz", "lacks scale_mm_per_px, tissue"),
        ("b.npz", r"flow is \(2, 4, 4, 2\)"),
        ("c.npz", "cannot be read"),
        ("g.npz", r"tissue is \(2, 4, 4\)"),
        ("h.npz", "scale_mm_per_px must be one positive number"),
        ("i.npz", r"flow is \(0, 4, 4, 2\)"),
        ("j.npz", "young_kpa must be one positive number"),
        ("k.npz", "scale_mm_per_px is no array of numbers"),
        ("l.npz", "cannot be read as .npz"),
        ("m.npz", "no regular file"),
        ("d.mp4", "give --scale in mm a pixel, or unknown"),
        ("e.zarr", "no such sequence"),
    ):
        with pytest.raises(UserError, match=message):
            first(tmp_path / name)
    phantom.write(tmp_path / "x", 0, anatomy_seed=0, recovered=False)
    with pytest.raises(UserError, match="holds no recovered flow"):
        first(tmp_path / "x")
