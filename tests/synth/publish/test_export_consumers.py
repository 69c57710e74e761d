"""Exports as the libraries that they are for read them, and as the geometry says."""

from __future__ import annotations

import gc
import json
import tarfile
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from fake_run import in_process
from fake_work import consistent
from PIL import Image
from ruamel.yaml import YAML
from typer.testing import CliRunner

from synth.cli import app
from synth.dataset import index, split
from synth.dataset.folder import Folder
from synth.dataset.store import Dataset, Sequence, Writer
from synth.errors import UserError
from synth.fields import FIELDS
from synth.job.schema import Job
from synth.publish.export import endonerf, hugging_face, overlay_video
from synth.publish.export.formats import FORMATS, export_dataset
from synth.render.camera.camera import Camera, project, rays


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six sequences with sides."""
    out = tmp_path_factory.mktemp("consumers") / "out"
    job = Job(
        sequences=6,
        frames=3,
        render={"size": (48, 36), "stereo_mm": 24.0},
        flow={"backend": "ideal"},
        card={"title": "Pulls: a test", "licence": "cc-by-4.0"},
    )
    in_process(job, out, consistent)
    split.keep_rule(out, split.parse_rule("anatomy", "0.5,0.25,0.25", [], False))
    index.write_index(Folder(out))
    return out


def by_index(root: Path) -> dict[int, Sequence]:
    return {sequence.index: sequence for sequence in Dataset(root)}


def sides(root: Path) -> dict[str, set[int]]:
    rows = index.read_index(root).to_pylist()
    return {side: {row["index"] for row in rows if row["split"] == side} for side in split.SIDES}


def test_every_format_is_named_in_the_help() -> None:
    said = CliRunner().invoke(app, ["export", "--help"], env={"COLUMNS": "300"}).output
    assert [name for name in FORMATS if name not in said] == []


@pytest.mark.slow
@pytest.mark.parametrize("group_bytes", [1 << 20, 30_000])
def test_datasets_gives_the_stores_values(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group_bytes: int
) -> None:
    datasets = pytest.importorskip("datasets")
    monkeypatch.setattr(hugging_face, "_GROUP_BYTES", group_bytes)
    monkeypatch.setattr(hugging_face, "_FILE_BYTES", 2 * group_bytes)
    export_dataset(root, tmp_path / "to", "hf")
    several = len(list((tmp_path / "to/frames").glob("train-*.parquet"))) > 1
    assert several == (group_bytes < 100_000)
    found = datasets.load_dataset(str(tmp_path / "to"), cache_dir=str(tmp_path / "cache"))
    told, stores = sides(root), by_index(root)
    assert {side: {row["sequence"] for row in rows} for side, rows in found.items()} == told
    height, width = stores[0].size
    features = found["train"].features
    assert features["flow"] == datasets.Array3D((height, width, 2), "float32")
    assert features["depth"] == datasets.Array2D((height, width), "float32")
    assert features["rgb"] == features["tool"] == datasets.Image()
    assert features["force"].length == 3
    for rows in found.values():
        for row in rows:
            sequence = stores[row["sequence"]]
            for name in features.keys() - {"sequence", "frame"}:
                stored = sequence[name][row["frame"]]
                given = np.asarray(row[name])
                assert np.array_equal(given > 0 if FIELDS[name].dtype == "bool" else given, stored), name
    numpy = found["test"].with_format("numpy")[2]
    assert numpy["flow"].dtype == np.float32
    assert numpy["rgb"].shape == (height, width, 3)


@pytest.mark.slow
def test_datasets_gives_what_is_known_of_sequences(root: Path, tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets")
    export_dataset(root, tmp_path / "to", "hf")
    found = datasets.load_dataset(str(tmp_path / "to"), "sequences", cache_dir=str(tmp_path / "cache"))
    stores = by_index(root)
    rows = [row for side in found.values() for row in side]
    assert {row["index"] for row in rows} == set(stores)
    for row in rows:
        sequence = stores[row["index"]]
        assert row["young_kpa"] == sequence.attrs["young_kpa"]
        assert json.loads(row["attributes"]) == sequence.attrs
        assert np.array_equal(np.asarray(row["tissue"]) > 0, sequence["tissue"][:])
        assert np.array_equal(np.asarray(row["area"]), sequence["area"][:])


def test_the_hubs_card_names_files_that_are_there_and_every_column(root: Path, tmp_path: Path) -> None:
    export_dataset(root, tmp_path / "to", "hf")
    text = (tmp_path / "to/README.md").read_text("utf-8")
    front = YAML(typ="safe").load(text.split("---")[1])
    assert (front["pretty_name"], front["license"]) == ("Pulls: a test", "cc-by-4.0")
    assert [one["config_name"] for one in front["configs"] if one["default"]] == ["frames"]
    for config in front["configs"]:
        assert [one["split"] for one in config["data_files"]] == list(split.SIDES)
        for one in config["data_files"]:
            assert list((tmp_path / "to").glob(one["path"]))
    for name in (*Dataset(root)[0].fields, "sequence", "frame", "young_kpa", "attributes"):
        assert f"| `{name}` |" in text


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # its reader leaves files open
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_webdataset_gives_arrays_as_arrays(root: Path, tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset", reason="WebDataset's library is not installed")
    export_dataset(root, tmp_path / "to", "webdataset")
    shards = sorted(str(path) for path in (tmp_path / "to").glob("*.tar"))
    stores, seen = by_index(root), 0
    for sample in webdataset.WebDataset(shards, shardshuffle=False).decode("rgb8"):
        key, t = sample["__key__"].split("_")
        sequence, seen = stores[int(key)], seen + 1
        for name in sequence.fields:
            stored = sequence[name][int(t)] if FIELDS[name].dims[0] == "frame" else sequence[name][:]
            given = sample[f"{name}.png" if name.startswith("rgb") else f"{name}.npy"]
            assert isinstance(given, np.ndarray)
            assert np.array_equal(given, stored), name
        assert sample["json"] == sequence.attrs
    assert seen == sum(sequence.frames for sequence in stores.values())
    held = {key for path in shards if "/test-" in path for key in _keys(path)}
    assert {int(key.split("_")[0]) for key in held} == sides(root)["test"]
    gc.collect()


def _keys(path: str) -> set[str]:
    with tarfile.open(path) as archive:
        return {name.split(".")[0] for name in archive.getnames()}


def drawn(*words: Any) -> np.ndarray:
    return np.stack(list(overlay_video.draw_film(*words)))


def film(path: Path) -> list[tuple[float, np.ndarray]]:
    """Time [s] and picture of each frame of a video."""
    with av.open(str(path)) as container:
        return [(float(one.time), one.to_ndarray(format="rgb24")) for one in container.decode(video=0)]


@pytest.mark.slow
def test_lerobot_gives_force_video_and_task(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own index, times and statistics; PyAV decodes, for its own decoder is not on every machine."""
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="LeRobot is not installed")
    pooled = pytest.importorskip("lerobot.datasets.compute_stats").aggregate_stats
    torch = pytest.importorskip("torch")

    def decoded(path: Path, times: list[float], tolerance_s: float, backend: Any = None) -> Any:
        frames = film(path)
        chosen = [min(frames, key=lambda frame: abs(frame[0] - time)) for time in times]
        assert max(abs(one[0] - time) for one, time in zip(chosen, times, strict=True)) < tolerance_s
        stacked = np.stack([picture for _, picture in chosen])
        return torch.from_numpy(stacked).permute(0, 3, 1, 2).float() / 255

    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr(lerobot, "decode_video_frames", decoded)
    export_dataset(root, tmp_path / "to", "lerobot")
    read = lerobot.LeRobotDataset("sulcus/test", root=tmp_path / "to")
    stores, told = by_index(root), sides(root)
    order = [k for side in split.SIDES for k in sorted(told[side])]
    assert (read.num_episodes, len(read)) == (6, 18)
    assert read.meta.info["splits"] == {"train": "0:3", "validation": "3:5", "test": "5:6"}
    for item in read:
        sequence = stores[order[int(item["episode_index"])]]
        t = int(item["frame_index"])
        assert item["force"].numpy() == pytest.approx(sequence["force"][t], rel=1e-6)
        assert float(item["young_kpa"]) == pytest.approx(sequence.attrs["young_kpa"], rel=1e-6)
        assert float(item["timestamp"]) == pytest.approx(sequence["time"][t], abs=1e-6)
        assert item["task"].startswith(sequence.attrs["scenario"]["gesture"]["kind"])
        picture = 255 * item["observation.images.left"].permute(1, 2, 0).numpy()
        assert np.abs(picture - sequence["rgb"][t]).mean() < 4
    fps = stores[0].attrs["fps"]
    before = lerobot.LeRobotDataset(
        "sulcus/test", root=tmp_path / "to", delta_timestamps={"force": [-1 / fps, 0.0]}
    )
    assert before[4]["force"][0].numpy() == pytest.approx(read[3]["force"].numpy())
    assert before[3]["force_is_pad"].tolist() == [True, False]
    rows = [
        {key: {"mean": _array(row, key, "mean"), **_rest(row, key)} for key in read.meta.stats}
        for row in _episodes(tmp_path / "to")
    ]
    for key, expected in pooled(rows).items():
        for name, value in expected.items():
            assert np.ravel(read.meta.stats[key][name]) == pytest.approx(np.ravel(value), rel=1e-5, abs=1e-7)


def _episodes(root: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    return rows


def _array(row: dict[str, Any], key: str, name: str) -> np.ndarray:
    return np.asarray(row[f"stats/{key}/{name}"])


def _rest(row: dict[str, Any], key: str) -> dict[str, np.ndarray]:
    start = f"stats/{key}/"
    return {name.removeprefix(start): np.asarray(row[name]) for name in row if name.startswith(start)}


def test_lerobots_files_are_as_its_format_says(root: Path, tmp_path: Path) -> None:
    export_dataset(root, tmp_path / "to", "lerobot")
    info = json.loads((tmp_path / "to/meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    rows = _episodes(tmp_path / "to")
    assert [row["dataset_to_index"] for row in rows] == [3, 6, 9, 12, 15, 18]
    for row in rows:
        for key in ("observation.images.left", "observation.images.right"):
            place = {name: row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
            frames = film(tmp_path / "to" / info["video_path"].format(video_key=key, **place))
            assert [time for time, _ in frames] == pytest.approx(np.arange(3) / info["fps"])
            assert list(frames[0][1].shape) == info["features"][key]["shape"]


def moving(out: Path, job: Job) -> list[Camera]:
    """A plane seen by a lens with distortion, off its middle, that shifts and turns."""
    width, height = job.render.size
    K = np.array([[900.0, 0, 30.0], [0, 900.0, 19.0], [0, 0, 1]])
    bent = np.array([-0.2, 0.05, 0.001, -0.002, 0.0])
    cameras = []
    for t in range(job.frames):
        turn = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]) * t)[0]
        place = np.array([0.5 * t, -0.3 * t, 300.0 + t])
        cameras.append(Camera(K, bent, turn, place, (width, height), 0.0, 300.0, 1 / 3))
    writer = Writer(out, 0, frames=job.frames, size=(height, width), job=job)
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float)
    poses = np.tile(np.eye(4), (job.frames, 1, 1))
    for t, camera in enumerate(cameras):
        start, way = rays(camera, pixels)
        hit = start - way * (start[..., 2] / way[..., 2])[:, None]  # the plane z = 0
        local = hit @ camera.rotation.T + camera.translation
        poses[t, :3, :3], poses[t, :3, 3] = camera.rotation, camera.translation
        shade = np.clip(128 + 40 * np.sin(hit[:, 0]) + 40 * np.cos(1.3 * hit[:, 1]), 0, 255)
        still = np.zeros((height, width))
        values = {
            "rgb": np.repeat(shade.reshape(height, width, 1), 3, axis=-1).astype(np.uint8),
            "depth": local[:, 2].reshape(height, width).astype(np.float32),
            "flow": np.zeros((height, width, 2), np.float32),
            "traction": np.zeros((height, width, 3), np.float32),
            "tool": columns < 5,
            "visible": still == 0,
            "glare": still > 0,
        }
        for name, value in values.items():
            writer.put_frame(name, t, value)
    writer.put("camera", poses)
    writer.put("time", np.arange(job.frames) / job.fps)
    writer.put("force", np.zeros((job.frames, 3)))
    writer.put("tissue", np.ones((height, width), bool))
    writer.put("area", np.ones((height, width), np.float32))
    writer.seal(
        K=K.tolist(),
        distortion=bent.tolist(),
        rotation=cameras[0].rotation.tolist(),
        translation=cameras[0].translation.tolist(),
        young_kpa=1.0,
        scale_mm_per_px=1 / 3,
        scenario={"sway": {"drift_mm": 1.0, "vibration_mm": 0.0}},
    )
    return cameras


def test_endonerfs_points_are_the_scenes(tmp_path: Path) -> None:
    """Back-projected as its readers do: c2w of axes right, up, backward; the axis at (W // 2, H // 2)."""
    job = Job(
        sequences=1,
        frames=3,
        render={"size": (64, 48)},
        flow={"backend": "ideal"},
        store={"extra": ["camera"]},
    )
    (tmp_path / "in").mkdir()
    cameras = moving(tmp_path / "in", job)
    export_dataset(tmp_path / "in", tmp_path / "to", "endonerf")
    here = tmp_path / "to/000000"
    told = np.load(here / "poses_bounds.npy")
    poses, bounds = told[:, :-2].reshape(-1, 3, 5), told[:, -2:]
    tall, wide, focal = poses[0, :, -1]
    rows, columns = np.mgrid[: int(tall), : int(wide)]
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = cameras[0].rotation, cameras[0].translation
    for t, camera in enumerate(cameras):
        c2w = np.concatenate([poses[t, :, :1], -poses[t, :, 1:3], poses[t, :, 3:4]], axis=1)
        depth = np.asarray(Image.open(here / f"depth/{t:06d}.png")).astype(float)
        mask = 1 - np.asarray(Image.open(here / f"masks/{t:06d}.png")) / 255.0
        seen = (mask > 0) & (depth > 0)
        assert 0.5 < seen.mean() < 1
        flat = np.stack([(columns - wide // 2) / focal, (rows - tall // 2) / focal, np.ones_like(depth)], -1)
        local = (flat * depth[..., None])[seen]
        # Axes of frame 0's camera, right, up and backward; brought to the scene's own.
        world = (local @ c2w[:, :3].T + c2w[:, 3]) * np.array([1, -1, -1]) * endonerf.UNIT_MM
        scene = (world - first[:3, 3]) @ first[:3, :3]
        assert np.abs(scene[:, 2]).max() < 0.15, "the plane is where it was; pixels of depth are not blended"
        assert np.median(np.abs(scene[:, 2])) < 0.03
        assert bounds[t] == pytest.approx([depth[seen].min(), depth[seen].max()])
        picture = np.asarray(Image.open(here / f"images/{t:06d}.png"))[seen].astype(float)
        drawn = np.clip(128 + 40 * np.sin(scene[:, 0]) + 40 * np.cos(1.3 * scene[:, 1]), 0, 255)
        assert np.abs(picture[:, 0] - drawn).mean() < 2.0
        where = project(camera, scene)
        assert (where[:, 0] > 4).all(), "the instrument is masked"


def test_endonerf_refuses_what_it_cannot_say(tmp_path: Path) -> None:
    job = Job(sequences=1, frames=3, render={"size": (64, 48)}, flow={"backend": "ideal"})
    (tmp_path / "in").mkdir()
    moving(tmp_path / "in", job)  # the pose is not kept
    with pytest.raises(UserError, match=r"store\.extra=\[camera\]"):
        export_dataset(tmp_path / "in", tmp_path / "to", "endonerf")
    lean = job.model_copy(update={"store": job.store.model_copy(update={"without": ("depth",)})})
    (tmp_path / "lean").mkdir()
    moving(tmp_path / "lean", lean)
    with pytest.raises(UserError, match="holds no depth"):
        export_dataset(tmp_path / "lean", tmp_path / "to", "endonerf")
    assert not (tmp_path / "to").exists()


def test_endonerfs_second_eye_is_rectified(tmp_path: Path) -> None:
    """Both eyes record one picture here, shifted to coincide at the tissue's depth; rectified they differ."""
    (tmp_path / "in").mkdir()
    job = Job(sequences=1, frames=3, render={"size": (48, 36), "stereo_mm": 1.2}, flow={"backend": "ideal"})
    consistent(job, 0, tmp_path / "in", lambda stage, done, of: None)
    export_dataset(tmp_path / "in", tmp_path / "to", "endonerf")
    about = json.loads((tmp_path / "to/000000/scene.json").read_text())
    left, right = (
        np.asarray(Image.open(tmp_path / f"to/000000/{name}/000001.png"))
        for name in ("images", "images_right")
    )
    depth_mm = Dataset(tmp_path / "in")[0]["depth"][1][18, 24]
    disparity = round(about["focal_px"] * about["baseline_mm"] / depth_mm)
    assert disparity == 4
    assert np.array_equal(right[:, :-disparity], left[:, disparity:])


def test_films_show_what_is_asked(root: Path, tmp_path: Path) -> None:
    sequence = Dataset(root)[0]
    bare = drawn(sequence, [])
    assert np.array_equal(bare, sequence["rgb"][:])
    forced, moved = (drawn(sequence, [name]) for name in ("force", "flow"))
    times = moved.shape[2] // sequence.size[1]
    assert forced.shape[1] > moved.shape[1] == times * sequence.size[0], "the curve is below the picture"
    plain = bare[2].repeat(times, axis=0).repeat(times, axis=1)
    changed = np.abs(forced[2, : len(plain)].astype(int) - plain).sum(-1) > 30
    size = np.linalg.norm(sequence["traction"][2], axis=-1)
    at = np.unravel_index(size.argmax(), size.shape)
    peak = np.array(at) + sequence["flow"][2][at][::-1]
    assert changed[tuple((times * (np.round(peak) + 0.5)).astype(int))], (
        "the glow is where the loaded tissue has moved to"
    )
    assert len(drawn(sequence, ["flow"], (0.5 / sequence.attrs["fps"], np.inf))) == 2
    with pytest.raises(UserError, match="holds no flow_recovered"):
        overlay_video.draw_film(sequence, ["recovered"])
    with pytest.raises(UserError, match="has no frame between"):
        overlay_video.draw_film(sequence, [], (90.0, 91.0))


def test_films_by_command(root: Path, tmp_path: Path) -> None:
    words = ["export", str(root), str(tmp_path / "to"), "--to", "video", "--overlay", "none", "--interval"]
    assert CliRunner().invoke(app, [*words, "0:0.05"]).exit_code == 0
    assert sorted(path.name for path in (tmp_path / "to").iterdir())[0] == "000000.mp4"
    assert len(film(tmp_path / "to/000000.mp4")) == sum(Dataset(root)[0]["time"][:] <= 0.05)
    for text in ("5", "2:1", "a:b"):
        said = CliRunner().invoke(app, [*words, text])
        assert isinstance(said.exception, UserError) or said.exit_code
    mixed = CliRunner().invoke(app, ["export", str(root), str(tmp_path / "x"), "--overlay", "flow"])
    assert mixed.exit_code
