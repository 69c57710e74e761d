"""Exports, read by the libraries that they are made for, and checked against the geometry."""

import gc
import io
import json
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from command import run
from PIL import Image
from torch.utils.data import DataLoader

from synth.cli import app
from synth.dataset import index, sequence_split
from synth.dataset.store import Dataset, Sequence, Writer
from synth.dataset.torch_dataset import TorchDataset
from synth.errors import UserError
from synth.fields import FIELDS
from synth.job.schema import Job
from synth.publish import sequence_video
from synth.publish.export import endonerf, hugging_face
from synth.publish.export.encoding import write_exr
from synth.publish.export.exporter_registry import EXPORTERS, export_dataset
from synth.render.camera.camera import Camera, project, rays


def by_index(root: Path) -> dict[int, Sequence]:
    return {sequence.index: sequence for sequence in Dataset(root)}


def sides(root: Path) -> dict[str, set[int]]:
    rows = index.read_index(root).to_pylist()
    return {side: {row["index"] for row in rows if row["split"] == side} for side in sequence_split.SIDES}


def test_folder(root: Path, tmp_path: Path) -> None:
    run(app, "export", root, tmp_path / "to")
    sequence = Dataset(root)[1]
    here = tmp_path / "to" / "000001"
    assert np.array_equal(np.asarray(Image.open(here / "rgb/0002.png")), sequence["rgb"][2])
    assert np.array_equal(np.asarray(Image.open(here / "rgb_right/0001.png")), sequence["rgb_right"][1])
    for name in sequence.fields:
        assert name.startswith("rgb") or np.array_equal(np.load(here / f"{name}.npy"), sequence[name][:])
    assert json.loads((here / "attributes.json").read_text()) == sequence.attrs


def test_linear_light_is_exported_as_exr(tmp_path: Path) -> None:
    import OpenEXR

    radiance = np.random.default_rng(0).random((6, 8, 3)).astype(np.float16)
    write_exr(tmp_path / "radiance" / "0001.exr", radiance)
    with OpenEXR.File(str(tmp_path / "radiance" / "0001.exr")) as file:
        assert np.array_equal(file.channels()["RGB"].pixels, radiance)


def test_hdf5(root: Path, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    export_dataset(root, tmp_path / "to", "hdf5")
    with h5py.File(tmp_path / "to/000001.h5") as file:
        sequence = Dataset(root)[1]
        for name in sequence.fields:
            assert np.array_equal(file[name][...], sequence[name][:])
        assert file["flow"].attrs["unit"] == "px"
        assert json.loads(file.attrs["attributes"])["content_hash"] == sequence.attrs["content_hash"]


def test_npz_of_the_published_code(root: Path, tmp_path: Path) -> None:
    export_dataset(root, tmp_path / "to", "d2fnet-npz")
    files = sorted((tmp_path / "to").glob("*/brain_surface_*_auto_projected_*_2d.npz"))
    sequence = Dataset(root)[0]
    with np.load(files[0]) as first, np.load(files[1]) as second:
        frames, nodes, _ = first["disp2d"].shape
        assert (frames, first["force_mag"].shape) == (3, (3, nodes))
        assert second["disp2d"].shape[1] == nodes, "that code assumes the same nodes in all files"
        total_n = np.linalg.norm(sequence["force"][:], axis=1) / 1000
        assert first["force_mag"].max(axis=1) == pytest.approx(total_n, rel=0.02)
        column, row = first["projected_pixels"][0, 100].astype(int)
        expected = sequence["flow"][2][row, column] * sequence.attrs["scale_mm_per_px"]
        assert first["disp2d"][2, 100] == pytest.approx(expected, rel=1e-5)
        x, y = first["projected_pixels"][2, 100].round().astype(int)
        assert first["depth"][2, 100] == sequence["depth"][2][y, x]


def test_frames_are_those_of_the_store(root: Path) -> None:
    frames = TorchDataset(root, ["rgb", "flow", "area", "force"])
    assert len(frames) == 18
    item, sequence = frames[4], Dataset(root)[1]
    assert (item["index"], item["frame"]) == (1, 1)
    assert np.array_equal(item["flow"], sequence["flow"][1])
    assert np.array_equal(item["area"], sequence["area"][:])
    assert np.array_equal(item["force"], sequence["force"][1])
    assert TorchDataset(root, ["rgb"], sequences=[1])[0]["index"] == 1
    pairs = TorchDataset(root, ["flow"], split="test", clip=2, transform=lambda item: item["flow"])
    assert len(pairs) == 2
    (last,) = sides(root)["test"]
    assert np.array_equal(pairs[1], by_index(root)[last]["flow"][1:3])
    for wrong in ({"split": "all"}, {"clip": 4}, {"clip": -1}, {"split": "test", "sequences": [0]}):
        with pytest.raises(UserError):
            TorchDataset(root, ["flow"], **wrong)
    for beyond in (18, -19):
        with pytest.raises(IndexError):
            frames[beyond]
    for same in (-14, np.int64(4), np.array(4), torch.tensor(4)):
        assert np.array_equal(frames[same]["flow"], item["flow"])
    assert item["scale_mm_per_px"] == sequence.attrs["scale_mm_per_px"]
    assert item["young_kpa"] == sequence.attrs["young_kpa"]
    apart = TorchDataset(root, "flow", clip=2, stride=2)
    assert len(apart) == 6
    assert np.array_equal(apart[1]["flow"], sequence["flow"][::2])
    assert [TorchDataset(root, "flow", step=2)[k]["frame"] for k in range(4)] == [0, 2, 0, 2]
    assert {*sequence.fields} <= TorchDataset(root)[0].keys()
    batch = next(iter(DataLoader(apart, batch_size=3)))
    assert batch["flow"].shape[:2] == (3, 2)
    assert batch["young_kpa"].shape == (3,)
    for wrong in ({"stride": 2}, {"step": 0}, {"clip": 3, "stride": 2}, {"clip": 2, "stride": 0}):
        with pytest.raises(UserError):
            TorchDataset(root, "flow", **wrong)
    for name in ("colour", "motion_recovered"):
        with pytest.raises(UserError):
            TorchDataset(root, [name])


def read_kitti(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px and where it is valid, by KITTI's development kit."""
    png = cv2.imread(str(path), -1)[..., ::-1].astype(float)
    return (png[..., :2] - 2**15) / 64, png[..., 2] > 0


def test_flow_pairs_are_read_by_the_rules_of_their_layouts(root: Path, tmp_path: Path) -> None:
    """As torchvision's Sintel and KittiFlow read them; each pair is in the tree of its side."""
    export_dataset(root, tmp_path / "to", "flow-pairs")
    stores, on = by_index(root), sides(root)
    rows = [row.split(",") for row in (tmp_path / "to/pairs.csv").read_text().splitlines()]
    assert rows.pop(0) == ["kind", "side", "scene", "flo", "pair", "sequence", "first", "second"]
    assert len(rows) == sum(sequence.frames - 1 for sequence in stores.values())
    assert (tmp_path / "to/README.md").is_file()
    for kind, side, scene, flo, pair, number, start, t in rows:
        sequence = stores[int(number)]
        assert (kind, int(start), int(number) in on[side]) == ("rest", 0, True)
        flow, visible = sequence["flow"][int(t)], sequence["visible"][int(t)]
        shown = sequence["tissue"][:] & ~sequence["tool"][0]
        tree = tmp_path / "to/rest/Sintel" / {"train": "training"}.get(side, side)
        clean, flows = (sorted((tree / name / scene).iterdir()) for name in ("clean", "flow"))
        assert [len(clean), len(flows)] == [2, 1], "a loader pairs neighbours"
        assert flows[0].name == flo
        read = cv2.readOpticalFlow(str(flows[0]))
        assert np.array_equal(read[shown], flow[shown])
        assert (read[~shown] > 1e9).all()
        hidden = cv2.imread(str(tree / f"occlusions/{scene}/frame_0001.png"), 0) > 0
        assert np.array_equal(hidden, shown & ~visible)
        other = {"train": "training", "test": "testing"}.get(side, side)
        kitti = tmp_path / "to/rest/KittiFlow" / other
        for name, valid in (("occ", shown), ("noc", shown & visible)):
            coded, there = read_kitti(kitti / f"flow_{name}/{int(pair):06d}_10.png")
            assert np.array_equal(there, valid)
            assert np.abs(coded - flow)[valid].max(initial=0) <= 1 / 128
        for file in (clean[1], kitti / f"image_2/{int(pair):06d}_11.png"):
            assert np.array_equal(np.asarray(Image.open(file)), sequence["rgb"][int(t)])


def test_pairs_of_neighbouring_frames_have_the_motion_between_them(tmp_path: Path) -> None:
    """A texture that slides by a pixel a frame, under an instrument that moves by two."""
    job = Job(sequences=1, frames=4, render={"size": (40, 30)}, store={"extra": ["flow_next_all"]})
    job = job.model_copy(update={"flow": job.flow.model_copy(update={"backend": "ideal"})})
    (tmp_path / "in").mkdir()
    writer = Writer(tmp_path / "in", 0, frames=4, size=(30, 40), job=job)
    shade = np.random.default_rng(0).integers(0, 256, (30, 60, 3), np.uint8)
    tissue, columns = np.ones((30, 40), bool), np.arange(40)[None].repeat(30, axis=0)
    for name, values in (("time", np.arange(4.0)), ("force", np.zeros((4, 3))), ("tissue", tissue)):
        writer.put(name, values)
    writer.put("area", np.ones((30, 40)))
    tools = [(columns >= 4 + 2 * t) & (columns < 10 + 2 * t) for t in range(4)]
    for t, tool in enumerate(tools):
        now = columns + t
        seen = (now < 40) & ~((now >= 4 + 2 * t) & (now < 10 + 2 * t))
        writer.put_frame("rgb", t, np.where(tool[..., None], 90, shade[:, 20 - t : 60 - t]).astype(np.uint8))
        writer.put_frame("flow", t, np.stack([np.full((30, 40), float(t)), np.zeros((30, 40))], axis=-1))
        step = np.where(tool, 2.0, 1.0) * (t < 3)
        writer.put_frame("flow_next_all", t, np.stack([step, 0 * step], axis=-1))
        for name, values in (("visible", seen), ("tool", tool), ("glare", ~tissue)):
            writer.put_frame(name, t, values)
        writer.put_frame("depth", t, np.full((30, 40), 300.0))
        writer.put_frame("traction", t, np.zeros((30, 40, 3)))
    writer.seal(scale_mm_per_px=0.1, young_kpa=1.0)
    export_dataset(tmp_path / "in", tmp_path / "to", "flow-pairs")
    tree = tmp_path / "to/flow_next/Sintel/training"
    assert len(list((tree / "clean/000000").iterdir())) == 4
    assert len(list((tree / "flow/000000").iterdir())) == 3
    for t in range(3):
        read = cv2.readOpticalFlow(str(tree / f"flow/000000/frame_{t + 1:04d}.flo"))
        assert np.array_equal(read[..., 0], np.where(tools[t], 2, 1))
        hidden = cv2.imread(str(tree / f"occlusions/000000/frame_{t + 1:04d}.png"), 0) > 0
        covered = ~tools[t] & (np.roll(tools[t + 1], -1, axis=1) | (columns == 39))
        # Tissue that was under the instrument at rest can't be followed by the flow from rest.
        known = (columns >= 13) & (columns < 39)
        assert np.array_equal(hidden[known], covered[known])
        flow, valid = read_kitti(tmp_path / f"to/flow_next/KittiFlow/training/flow_occ/{t:06d}_10.png")
        assert valid.all()
        assert np.array_equal(flow[..., 0], np.where(tools[t], 2, 1))


@pytest.mark.slow
@pytest.mark.parametrize("group_bytes", [1 << 20, 30_000])
def test_datasets_gives_the_stores_values(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group_bytes: int
) -> None:
    datasets = pytest.importorskip("datasets")
    monkeypatch.setattr(hugging_face, "_GROUP_BYTES", group_bytes)
    monkeypatch.setattr(hugging_face, "_GROUPS", 2)
    export_dataset(root, tmp_path / "to", "hf")
    several = len(list((tmp_path / "to/frames").glob("train-*.parquet"))) > 1
    assert several == (group_bytes < 100_000)
    found = datasets.load_dataset(str(tmp_path / "to"), cache_dir=str(tmp_path / "cache"))
    stores = by_index(root)
    assert {side: {row["sequence"] for row in rows} for side, rows in found.items()} == sides(root)
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
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # its reader leaves files open
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_webdataset_gives_arrays_as_arrays(root: Path, tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset", reason="WebDataset's library is not installed")
    export_dataset(root, tmp_path / "to", "webdataset")
    shards = sorted(str(path) for path in (tmp_path / "to").glob("*.tar"))
    stores, count = by_index(root), 0
    for sample in webdataset.WebDataset(shards, shardshuffle=False).decode("rgb8"):
        key, t = sample["__key__"].split("_")
        sequence, count = stores[int(key)], count + 1
        for name in sequence.fields:
            stored = sequence[name][int(t)] if FIELDS[name].dims[0] == "frame" else sequence[name][:]
            given = sample[f"{name}.png" if name.startswith("rgb") else f"{name}.npy"]
            assert isinstance(given, np.ndarray)
            assert np.array_equal(given, stored), name
        assert sample["json"] == sequence.attrs
    assert count == sum(sequence.frames for sequence in stores.values())
    names = list[str]()
    for path in (tmp_path / "to").glob("test-*.tar"):
        with tarfile.open(path) as archive:
            names += archive.getnames()
    assert {int(name.split("_")[0]) for name in names} == sides(root)["test"]
    gc.collect()


def test_a_format_of_another_package_writes_and_its_faults_name_it(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EXPORTERS, "_added", {})

    def write_curves(dataset: Dataset, target: Path) -> None:
        for sequence in dataset:
            np.savetxt(target / f"{sequence.index}.csv", sequence["force"][:])

    EXPORTERS.add("curves", write_curves)
    assert export_dataset(root, tmp_path / "to", "curves") == len(Dataset(root))
    assert np.loadtxt(tmp_path / "to/1.csv") == pytest.approx(by_index(root)[1]["force"][:])
    assert (tmp_path / "to/split.csv").exists()

    EXPORTERS.add("broken", lambda dataset, target: 1 / 0)
    with pytest.raises(UserError, match="broken"):
        export_dataset(root, tmp_path / "other", "broken")
    assert not (tmp_path / "other").exists()


def drawn(*words: Any) -> np.ndarray:
    return np.stack(list(sequence_video.draw_video(*words)))


def moving(out: Path, job: Job) -> list[Camera]:
    """Writes a sequence of a plane by a moving camera with distortion and off-centre principal point."""
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
    depths, points = [], np.zeros((0, 3))  # of the rest frame's pixels, world axes
    for t, camera in enumerate(cameras):
        start, way = camera.centre, rays(camera, pixels) @ camera.rotation
        hit = start - way * (start[2] / way[:, 2])[:, None]  # the plane z = 0
        local = hit @ camera.rotation.T + camera.translation
        poses[t, :3, :3], poses[t, :3, 3] = camera.rotation, camera.translation
        points = points if t else hit
        depths.append(local[:, 2])
        moved = points @ camera.rotation.T + camera.translation
        flow = cv2.projectPoints(moved, np.zeros(3), np.zeros(3), K, bent)[0].reshape(-1, 2) - pixels
        motion = moved - (points @ cameras[0].rotation.T + cameras[0].translation)
        shade = np.clip(128 + 40 * np.sin(hit[:, 0]) + 40 * np.cos(1.3 * hit[:, 1]), 0, 255)
        values = {
            "rgb": np.repeat(shade.reshape(height, width, 1), 3, axis=-1).astype(np.uint8),
            "depth": local[:, 2].reshape(height, width).astype(np.float32),
            "flow": flow.reshape(height, width, 2).astype(np.float32),
            "motion": motion.reshape(height, width, 3).astype(np.float32),
            "traction": np.zeros((height, width, 3), np.float32),
            "tool": columns < 5,
            "visible": (rows + columns + t) % 3 > 0,
            "glare": np.zeros((height, width), bool),
        }
        for name in ("rgb", "flow", "visible", "depth"):
            values[f"{name}_right"] = values[name]  # not used
        for name, value in values.items():
            writer.put_frame(name, t, value)
    baseline, shifted = job.render.stereo_mm, K + np.array([[0, 0, 70.0], [0, 0, 0], [0, 0, 0]])
    disparity = K[0, 0] * baseline / depths[0] - (shifted[0, 2] - K[0, 2])
    writer.put("disparity", disparity.reshape(height, width).astype(np.float32))
    writer.put("camera", poses)
    writer.put("time", np.arange(job.frames) / job.fps)
    writer.put("force", np.zeros((job.frames, 3)))
    writer.put("tissue", np.ones((height, width), bool))
    writer.put("area", np.ones((height, width), np.float32))
    place = cameras[0].translation
    both = {"distortion": bent.tolist(), "rotation": cameras[0].rotation.tolist()}
    right = {
        "K": shifted.tolist(),
        "translation": (place - [baseline, 0, 0]).tolist(),
        "baseline_mm": baseline,
    }
    left = {"K": K.tolist(), "translation": place.tolist(), "scenario": {"camera_motion": {"drift_mm": 1.0}}}
    writer.seal(**both, **left, right=both | right, young_kpa=1.0, scale_mm_per_px=1 / 3)
    return cameras


def test_points_of_the_endonerf_export_are_on_the_scene(tmp_path: Path) -> None:
    """Back-projected as by its readers: c2w of axes right, up, backward; the axis at (W // 2, H // 2)."""
    more = {"flow": {"backend": "ideal"}, "store": {"extra": ["camera"]}}
    job = Job(sequences=1, frames=3, render={"size": (64, 48)}, **more)
    (tmp_path / "in").mkdir()
    cameras = moving(tmp_path / "in", job)
    export_dataset(tmp_path / "in", tmp_path / "to", "endonerf")
    here = tmp_path / "to/000000"
    rows_17 = np.load(here / "poses_bounds.npy")
    poses, bounds = rows_17[:, :-2].reshape(-1, 3, 5), rows_17[:, -2:]
    tall, wide, focal = poses[0, :, -1]
    rows, columns = np.mgrid[: int(tall), : int(wide)]
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = cameras[0].rotation, cameras[0].translation
    for t, camera in enumerate(cameras):
        c2w = np.concatenate([poses[t, :, :1], -poses[t, :, 1:3], poses[t, :, 3:4]], axis=1)
        depth = np.asarray(Image.open(here / f"depth/{t:06d}.png")).astype(float)
        mask = 1 - np.asarray(Image.open(here / f"masks/{t:06d}.png")) / 255.0
        visible = (mask > 0) & (depth > 0)
        assert 0.5 < visible.mean() < 1
        flat = np.stack([(columns - wide // 2) / focal, (rows - tall // 2) / focal, np.ones_like(depth)], -1)
        local = (flat * depth[..., None])[visible]
        # From axes of frame 0's camera (right, up, backward) to those of the scene.
        world = (local @ c2w[:, :3].T + c2w[:, 3]) * np.array([1, -1, -1]) * endonerf.UNIT_MM
        scene = (world - first[:3, 3]) @ first[:3, :3]
        assert np.abs(scene[:, 2]).max() < 0.15, "points are on the plane; depths are not interpolated"
        assert np.median(np.abs(scene[:, 2])) < 0.03
        assert bounds[t] == pytest.approx([depth[visible].min(), depth[visible].max()])
        picture = np.asarray(Image.open(here / f"images/{t:06d}.png"))[visible].astype(float)
        drawn = np.clip(128 + 40 * np.sin(scene[:, 0]) + 40 * np.cos(1.3 * scene[:, 1]), 0, 255)
        assert np.abs(picture[:, 0] - drawn).mean() < 2.0
        where = project(camera, scene)
        assert (where[:, 0] > 4).all(), "the instrument is masked"


def test_tracks_of_the_tapvid_export_follow_the_scene(tmp_path: Path) -> None:
    """In the picture, in space projected by the stated camera, and their visibility."""
    render = {"size": (64, 48), "stereo_mm": 24.0}
    job = Job(sequences=1, frames=4, render=render, flow={"backend": "ideal"}, store={"extra": ["camera"]})
    (tmp_path / "in").mkdir()
    cameras = moving(tmp_path / "in", job)
    export_dataset(tmp_path / "in", tmp_path / "to", "tapvid")
    with np.load(tmp_path / "to/000000.npz", allow_pickle=False) as file:
        held = dict(file)
    sequence = Dataset(tmp_path / "in")[0]
    size = np.array(held["video"].shape[2:0:-1])
    places = held["points"] * size - 0.5
    columns, rows = held["queries_xyt"][:, :2].astype(int).T
    assert 500 < len(columns) <= 1024
    assert places[:, 0] == pytest.approx(np.stack([columns, rows], axis=1), abs=1e-4)
    fx, fy, cx, cy = held["fx_fy_cx_cy"]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    for t, camera in enumerate(cameras):
        assert places[:, t] - places[:, 0] == pytest.approx(sequence["flow"][t][rows, columns], abs=1e-4)
        local = held["tracks_XYZ"][t].astype(float)
        projected = cv2.projectPoints(local, np.zeros(3), np.zeros(3), K, held["distortion"])[0][:, 0]
        assert projected - 0.5 == pytest.approx(places[:, t], abs=1e-3)
        assert ((1000 * local - camera.translation) @ camera.rotation)[:, 2] == pytest.approx(0, abs=1e-3)
        assert np.array_equal(held["visibility"][t], sequence["visible"][t][rows, columns])
        picture = np.asarray(Image.open(io.BytesIO(held["images_jpeg_bytes"][t])))
        assert np.array_equal(picture, held["video"][t])
    assert np.array_equal(held["occluded"], ~held["visibility"].T)
    assert not held["occluded"][:, 0].any()
    assert held["occluded"].any()
    assert np.array_equal(held["video"], sequence["rgb"][:])


def test_videos_have_the_requested_overlays(root: Path) -> None:
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
    at_peak = tuple((times * (np.round(peak) + 0.5)).astype(int))
    assert changed[at_peak], "the overlay follows the loaded tissue"
    assert len(drawn(sequence, ["flow"], (0.5 / sequence.attrs["fps"], np.inf))) == 2
