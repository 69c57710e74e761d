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


def index_sequences(root: Path) -> dict[int, Sequence]:
    return {sequence.index: sequence for sequence in Dataset(root)}


def read_sides(root: Path) -> dict[str, set[int]]:
    rows = index.read_index(root).to_pylist()
    return {side: {row["index"] for row in rows if row["split"] == side} for side in sequence_split.SIDES}


def test_folder(root: Path, tmp_path: Path) -> None:
    run(app, "export", root, tmp_path / "to")
    sequence = Dataset(root)[1]
    folder = tmp_path / "to" / "000001"
    assert np.array_equal(np.asarray(Image.open(folder / "rgb/0002.png")), sequence["rgb"][2])
    assert np.array_equal(np.asarray(Image.open(folder / "rgb_right/0001.png")), sequence["rgb_right"][1])
    for name in sequence.fields:
        assert name.startswith("rgb") or np.array_equal(np.load(folder / f"{name}.npy"), sequence[name][:])
    assert json.loads((folder / "attributes.json").read_text()) == sequence.attrs


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
    with np.load(files[0]) as first_file, np.load(files[1]) as second_file:
        frames, nodes, _ = first_file["disp2d"].shape
        assert (frames, first_file["force_mag"].shape) == (3, (3, nodes))
        assert second_file["disp2d"].shape[1] == nodes, "that code assumes the same nodes in all files"
        total_n = np.linalg.norm(sequence["force"][:], axis=1) / 1000
        assert first_file["force_mag"].max(axis=1) == pytest.approx(total_n, rel=0.02)
        column, row = first_file["projected_pixels"][0, 100].astype(int)
        expected = sequence["flow"][2][row, column] * sequence.attrs["scale_mm_per_px"]
        assert first_file["disp2d"][2, 100] == pytest.approx(expected, rel=1e-5)
        x, y = first_file["projected_pixels"][2, 100].round().astype(int)
        assert first_file["depth"][2, 100] == sequence["depth"][2][y, x]


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
    (test_index,) = read_sides(root)["test"]
    assert np.array_equal(pairs[1], index_sequences(root)[test_index]["flow"][1:3])
    for settings in ({"split": "all"}, {"clip": 4}, {"clip": -1}, {"split": "test", "sequences": [0]}):
        with pytest.raises(UserError):
            TorchDataset(root, ["flow"], **settings)
    for bad_position in (18, -19):
        with pytest.raises(IndexError):
            frames[bad_position]
    for position in (-14, np.int64(4), np.array(4), torch.tensor(4)):
        assert np.array_equal(frames[position]["flow"], item["flow"])
    assert item["scale_mm_per_px"] == sequence.attrs["scale_mm_per_px"]
    assert item["young_kpa"] == sequence.attrs["young_kpa"]
    strided_frames = TorchDataset(root, "flow", clip=2, stride=2)
    assert len(strided_frames) == 6
    assert np.array_equal(strided_frames[1]["flow"], sequence["flow"][::2])
    assert [TorchDataset(root, "flow", step=2)[k]["frame"] for k in range(4)] == [0, 2, 0, 2]
    assert {*sequence.fields} <= TorchDataset(root)[0].keys()
    batch = next(iter(DataLoader(strided_frames, batch_size=3)))
    assert batch["flow"].shape[:2] == (3, 2)
    assert batch["young_kpa"].shape == (3,)
    for settings in ({"stride": 2}, {"step": 0}, {"clip": 3, "stride": 2}, {"clip": 2, "stride": 0}):
        with pytest.raises(UserError):
            TorchDataset(root, "flow", **settings)
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
    stores, side_members = index_sequences(root), read_sides(root)
    rows = [row.split(",") for row in (tmp_path / "to/pairs.csv").read_text().splitlines()]
    assert rows.pop(0) == ["kind", "side", "scene", "flo", "pair", "sequence", "first", "second"]
    assert len(rows) == sum(sequence.frames - 1 for sequence in stores.values())
    assert (tmp_path / "to/README.md").is_file()
    for kind, side, scene, flo, pair, number, start, t in rows:
        sequence = stores[int(number)]
        assert (kind, int(start), int(number) in side_members[side]) == ("rest", 0, True)
        flow, visible = sequence["flow"][int(t)], sequence["visible"][int(t)]
        shown_pixels = sequence["tissue"][:] & ~sequence["tool"][0]
        tree = tmp_path / "to/rest/Sintel" / {"train": "training"}.get(side, side)
        clean, flows = (sorted((tree / name / scene).iterdir()) for name in ("clean", "flow"))
        assert [len(clean), len(flows)] == [2, 1], "a loader pairs neighbours"
        assert flows[0].name == flo
        stored_flow = cv2.readOpticalFlow(str(flows[0]))
        assert np.array_equal(stored_flow[shown_pixels], flow[shown_pixels])
        assert (stored_flow[~shown_pixels] > 1e9).all()
        hidden = cv2.imread(str(tree / f"occlusions/{scene}/frame_0001.png"), 0) > 0
        assert np.array_equal(hidden, shown_pixels & ~visible)
        kitti_side = {"train": "training", "test": "testing"}.get(side, side)
        kitti = tmp_path / "to/rest/KittiFlow" / kitti_side
        for name, valid in (("occ", shown_pixels), ("noc", shown_pixels & visible)):
            kitti_flow, kitti_valid = read_kitti(kitti / f"flow_{name}/{int(pair):06d}_10.png")
            assert np.array_equal(kitti_valid, valid)
            assert np.abs(kitti_flow - flow)[valid].max(initial=0) <= 1 / 128
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
        moved_columns = columns + t
        visible = (moved_columns < 40) & ~((moved_columns >= 4 + 2 * t) & (moved_columns < 10 + 2 * t))
        writer.put_frame("rgb", t, np.where(tool[..., None], 90, shade[:, 20 - t : 60 - t]).astype(np.uint8))
        writer.put_frame("flow", t, np.stack([np.full((30, 40), float(t)), np.zeros((30, 40))], axis=-1))
        step = np.where(tool, 2.0, 1.0) * (t < 3)
        writer.put_frame("flow_next_all", t, np.stack([step, 0 * step], axis=-1))
        for name, values in (("visible", visible), ("tool", tool), ("glare", ~tissue)):
            writer.put_frame(name, t, values)
        writer.put_frame("depth", t, np.full((30, 40), 300.0))
        writer.put_frame("traction", t, np.zeros((30, 40, 3)))
    writer.seal(scale_mm_per_px=0.1, young_kpa=1.0)
    export_dataset(tmp_path / "in", tmp_path / "to", "flow-pairs")
    tree = tmp_path / "to/flow_next/Sintel/training"
    assert len(list((tree / "clean/000000").iterdir())) == 4
    assert len(list((tree / "flow/000000").iterdir())) == 3
    for t in range(3):
        stored_flow = cv2.readOpticalFlow(str(tree / f"flow/000000/frame_{t + 1:04d}.flo"))
        assert np.array_equal(stored_flow[..., 0], np.where(tools[t], 2, 1))
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
    has_several = len(list((tmp_path / "to/frames").glob("train-*.parquet"))) > 1
    assert has_several == (group_bytes < 100_000)
    splits = datasets.load_dataset(str(tmp_path / "to"), cache_dir=str(tmp_path / "cache"))
    stores = index_sequences(root)
    assert {side: {row["sequence"] for row in rows} for side, rows in splits.items()} == read_sides(root)
    height, width = stores[0].size
    features = splits["train"].features
    assert features["flow"] == datasets.Array3D((height, width, 2), "float32")
    assert features["depth"] == datasets.Array2D((height, width), "float32")
    assert features["rgb"] == features["tool"] == datasets.Image()
    assert features["force"].length == 3
    for rows in splits.values():
        for row in rows:
            sequence = stores[row["sequence"]]
            for name in features.keys() - {"sequence", "frame"}:
                stored = sequence[name][row["frame"]]
                values = np.asarray(row[name])
                assert np.array_equal(values > 0 if FIELDS[name].dtype == "bool" else values, stored), name
    numpy_row = splits["test"].with_format("numpy")[2]
    assert numpy_row["flow"].dtype == np.float32
    assert numpy_row["rgb"].shape == (height, width, 3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # its reader leaves files open
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_webdataset_gives_arrays_as_arrays(root: Path, tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset", reason="WebDataset's library is not installed")
    export_dataset(root, tmp_path / "to", "webdataset")
    shards = sorted(str(path) for path in (tmp_path / "to").glob("*.tar"))
    stores, count = index_sequences(root), 0
    for sample in webdataset.WebDataset(shards, shardshuffle=False).decode("rgb8"):
        key, t = sample["__key__"].split("_")
        sequence, count = stores[int(key)], count + 1
        for name in sequence.fields:
            stored = sequence[name][int(t)] if FIELDS[name].dims[0] == "frame" else sequence[name][:]
            values = sample[f"{name}.png" if name.startswith("rgb") else f"{name}.npy"]
            assert isinstance(values, np.ndarray)
            assert np.array_equal(values, stored), name
        assert sample["json"] == sequence.attrs
    assert count == sum(sequence.frames for sequence in stores.values())
    names = list[str]()
    for path in (tmp_path / "to").glob("test-*.tar"):
        with tarfile.open(path) as archive:
            names += archive.getnames()
    assert {int(name.split("_")[0]) for name in names} == read_sides(root)["test"]
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
    assert np.loadtxt(tmp_path / "to/1.csv") == pytest.approx(index_sequences(root)[1]["force"][:])
    assert (tmp_path / "to/split.csv").exists()

    EXPORTERS.add("broken", lambda dataset, target: 1 / 0)
    with pytest.raises(UserError, match="broken"):
        export_dataset(root, tmp_path / "other", "broken")
    assert not (tmp_path / "other").exists()


def draw_frames(*arguments: Any) -> np.ndarray:
    return np.stack(list(sequence_video.draw_video(*arguments)))


def write_moving_sequence(out: Path, job: Job) -> list[Camera]:
    """Writes a sequence of a plane by a moving camera with distortion and off-centre principal point."""
    width, height = job.render.size
    K = np.array([[900.0, 0, 30.0], [0, 900.0, 19.0], [0, 0, 1]])
    distortion = np.array([-0.2, 0.05, 0.001, -0.002, 0.0])
    cameras = []
    for t in range(job.frames):
        rotation = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]) * t)[0]
        translation = np.array([0.5 * t, -0.3 * t, 300.0 + t])
        cameras.append(Camera(K, distortion, rotation, translation, (width, height), 0.0, 300.0, 1 / 3))
    writer = Writer(out, 0, frames=job.frames, size=(height, width), job=job)
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float)
    poses = np.tile(np.eye(4), (job.frames, 1, 1))
    depths, points = [], np.zeros((0, 3))  # of the rest frame's pixels, world axes
    for t, camera in enumerate(cameras):
        origin, directions = camera.centre, rays(camera, pixels) @ camera.rotation
        hits = origin - directions * (origin[2] / directions[:, 2])[:, None]  # the plane z = 0
        camera_points = hits @ camera.rotation.T + camera.translation
        poses[t, :3, :3], poses[t, :3, 3] = camera.rotation, camera.translation
        points = points if t else hits
        depths.append(camera_points[:, 2])
        moved_points = points @ camera.rotation.T + camera.translation
        flow = (
            cv2.projectPoints(moved_points, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)
            - pixels
        )
        motion = moved_points - (points @ cameras[0].rotation.T + cameras[0].translation)
        shade = np.clip(128 + 40 * np.sin(hits[:, 0]) + 40 * np.cos(1.3 * hits[:, 1]), 0, 255)
        values = {
            "rgb": np.repeat(shade.reshape(height, width, 1), 3, axis=-1).astype(np.uint8),
            "depth": camera_points[:, 2].reshape(height, width).astype(np.float32),
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
    baseline, K_right = job.render.stereo_mm, K + np.array([[0, 0, 70.0], [0, 0, 0], [0, 0, 0]])
    disparity = K[0, 0] * baseline / depths[0] - (K_right[0, 2] - K[0, 2])
    writer.put("disparity", disparity.reshape(height, width).astype(np.float32))
    writer.put("camera", poses)
    writer.put("time", np.arange(job.frames) / job.fps)
    writer.put("force", np.zeros((job.frames, 3)))
    writer.put("tissue", np.ones((height, width), bool))
    writer.put("area", np.ones((height, width), np.float32))
    translation = cameras[0].translation
    shared = {"distortion": distortion.tolist(), "rotation": cameras[0].rotation.tolist()}
    right = {
        "K": K_right.tolist(),
        "translation": (translation - [baseline, 0, 0]).tolist(),
        "baseline_mm": baseline,
    }
    left = {
        "K": K.tolist(),
        "translation": translation.tolist(),
        "scenario": {"camera_motion": {"drift_mm": 1.0}},
    }
    writer.seal(**shared, **left, right=shared | right, young_kpa=1.0, scale_mm_per_px=1 / 3)
    return cameras


def test_points_of_the_endonerf_export_are_on_the_scene(tmp_path: Path) -> None:
    """Back-projected as by its readers: c2w of axes right, up, backward; the axis at (W // 2, H // 2)."""
    sections = {"flow": {"backend": "ideal"}, "store": {"extra": ["camera"]}}
    job = Job(sequences=1, frames=3, render={"size": (64, 48)}, **sections)
    (tmp_path / "in").mkdir()
    cameras = write_moving_sequence(tmp_path / "in", job)
    export_dataset(tmp_path / "in", tmp_path / "to", "endonerf")
    folder = tmp_path / "to/000000"
    rows_17 = np.load(folder / "poses_bounds.npy")
    poses, bounds = rows_17[:, :-2].reshape(-1, 3, 5), rows_17[:, -2:]
    height, width, focal = poses[0, :, -1]
    rows, columns = np.mgrid[: int(height), : int(width)]
    rest_pose = np.eye(4)
    rest_pose[:3, :3], rest_pose[:3, 3] = cameras[0].rotation, cameras[0].translation
    for t, camera in enumerate(cameras):
        c2w = np.concatenate([poses[t, :, :1], -poses[t, :, 1:3], poses[t, :, 3:4]], axis=1)
        depth = np.asarray(Image.open(folder / f"depth/{t:06d}.png")).astype(float)
        mask = 1 - np.asarray(Image.open(folder / f"masks/{t:06d}.png")) / 255.0
        visible = (mask > 0) & (depth > 0)
        assert 0.5 < visible.mean() < 1
        directions = np.stack(
            [(columns - width // 2) / focal, (rows - height // 2) / focal, np.ones_like(depth)], -1
        )
        camera_points = (directions * depth[..., None])[visible]
        # From axes of frame 0's camera (right, up, backward) to those of the scene.
        world = (camera_points @ c2w[:, :3].T + c2w[:, 3]) * np.array([1, -1, -1]) * endonerf.UNIT_MM
        scene = (world - rest_pose[:3, 3]) @ rest_pose[:3, :3]
        assert np.abs(scene[:, 2]).max() < 0.15, "points are on the plane; depths are not interpolated"
        assert np.median(np.abs(scene[:, 2])) < 0.03
        assert bounds[t] == pytest.approx([depth[visible].min(), depth[visible].max()])
        picture = np.asarray(Image.open(folder / f"images/{t:06d}.png"))[visible].astype(float)
        expected = np.clip(128 + 40 * np.sin(scene[:, 0]) + 40 * np.cos(1.3 * scene[:, 1]), 0, 255)
        assert np.abs(picture[:, 0] - expected).mean() < 2.0
        pixels = project(camera, scene)
        assert (pixels[:, 0] > 4).all(), "the instrument is masked"


def test_tracks_of_the_tapvid_export_follow_the_scene(tmp_path: Path) -> None:
    """In the picture, in space projected by the stated camera, and their visibility."""
    render = {"size": (64, 48), "stereo_mm": 24.0}
    job = Job(sequences=1, frames=4, render=render, flow={"backend": "ideal"}, store={"extra": ["camera"]})
    (tmp_path / "in").mkdir()
    cameras = write_moving_sequence(tmp_path / "in", job)
    export_dataset(tmp_path / "in", tmp_path / "to", "tapvid")
    with np.load(tmp_path / "to/000000.npz", allow_pickle=False) as file:
        arrays = dict(file)
    sequence = Dataset(tmp_path / "in")[0]
    size = np.array(arrays["video"].shape[2:0:-1])
    positions = arrays["points"] * size - 0.5
    columns, rows = arrays["queries_xyt"][:, :2].astype(int).T
    assert 500 < len(columns) <= 1024
    assert positions[:, 0] == pytest.approx(np.stack([columns, rows], axis=1), abs=1e-4)
    fx, fy, cx, cy = arrays["fx_fy_cx_cy"]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    for t, camera in enumerate(cameras):
        assert positions[:, t] - positions[:, 0] == pytest.approx(
            sequence["flow"][t][rows, columns], abs=1e-4
        )
        camera_points = arrays["tracks_XYZ"][t].astype(float)
        projected = cv2.projectPoints(camera_points, np.zeros(3), np.zeros(3), K, arrays["distortion"])[0][
            :, 0
        ]
        assert projected - 0.5 == pytest.approx(positions[:, t], abs=1e-3)
        assert ((1000 * camera_points - camera.translation) @ camera.rotation)[:, 2] == pytest.approx(
            0, abs=1e-3
        )
        assert np.array_equal(arrays["visibility"][t], sequence["visible"][t][rows, columns])
        picture = np.asarray(Image.open(io.BytesIO(arrays["images_jpeg_bytes"][t])))
        assert np.array_equal(picture, arrays["video"][t])
    assert np.array_equal(arrays["occluded"], ~arrays["visibility"].T)
    assert not arrays["occluded"][:, 0].any()
    assert arrays["occluded"].any()
    assert np.array_equal(arrays["video"], sequence["rgb"][:])


def test_videos_have_the_requested_overlays(root: Path) -> None:
    sequence = Dataset(root)[0]
    plain_video = draw_frames(sequence, [])
    assert np.array_equal(plain_video, sequence["rgb"][:])
    force_video, flow_video = (draw_frames(sequence, [name]) for name in ("force", "flow"))
    scale = flow_video.shape[2] // sequence.size[1]
    assert force_video.shape[1] > flow_video.shape[1] == scale * sequence.size[0], (
        "the curve is below the picture"
    )
    enlarged = plain_video[2].repeat(scale, axis=0).repeat(scale, axis=1)
    changed_pixels = np.abs(force_video[2, : len(enlarged)].astype(int) - enlarged).sum(-1) > 30
    load = np.linalg.norm(sequence["traction"][2], axis=-1)
    pixel = np.unravel_index(load.argmax(), load.shape)
    peak = np.array(pixel) + sequence["flow"][2][pixel][::-1]
    peak_pixel = tuple((scale * (np.round(peak) + 0.5)).astype(int))
    assert changed_pixels[peak_pixel], "the overlay follows the loaded tissue"
    assert len(draw_frames(sequence, ["flow"], (0.5 / sequence.attrs["fps"], np.inf))) == 2
