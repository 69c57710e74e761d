"""Bags, DICOM and unknown files as recorders leave them: read, or named with the way out."""

import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from fake_recording import texture

from bench.importers import importer_registry
from synth.errors import UserError

pytest.importorskip("rosbags")
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FPS, START, COUNT = 25, 1_700_000_000, 10
PICTURES = [np.roll(texture(96, 128, 1), 2 * k, axis=1) for k in range(COUNT)]
STORE = get_typestore(Stores.ROS2_HUMBLE)
for name, text in {
    "foxglove_msgs/msg/CompressedVideo": "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\n"
    "string format\n",
    "device_msgs/msg/Reading": "std_msgs/Header header\nbool saturated\ngeometry_msgs/WrenchStamped wrench\n"
    "sensor_msgs/Temperature temperature\n",
    "device_msgs/msg/Two": "geometry_msgs/Wrench left\ngeometry_msgs/Wrench right\n",
}.items():
    STORE.register(get_types_from_msg(text, name))
T = STORE.types
Topics = Mapping[str, tuple[str, list[tuple[float, Any]]]]


def stamp(s: float) -> Any:
    return T["builtin_interfaces/msg/Time"](sec=START + int(s), nanosec=round(1e9 * (s - int(s))))


def head(s: float) -> Any:
    return T["std_msgs/msg/Header"](stamp=stamp(s), frame_id="")


def wrench(s: float) -> Any:
    vector = T["geometry_msgs/msg/Vector3"]
    return T["geometry_msgs/msg/Wrench"](force=vector(0.0, -0.5 * s, 1.0), torque=vector(9.0, 9.0, 9.0))


def bag(path: Path, topics: Topics, plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer(path, version=9, storage_plugin=plugin) as out:
        for topic, (kind, messages) in topics.items():
            connection = out.add_connection(topic, kind, typestore=STORE)
            for s, message in messages:
                out.write(connection, round(1e9 * (START + s)), STORE.serialize_cdr(message, kind))
    return path


def jpegs() -> tuple[str, list[tuple[float, Any]]]:
    kind = "sensor_msgs/msg/CompressedImage"
    data = [cv2.imencode(".jpg", rgb[..., ::-1])[1].ravel() for rgb in PICTURES]
    return kind, [(k / FPS, T[kind](header=head(k / FPS), format="jpeg", data=d)) for k, d in enumerate(data)]


def packets(codec: str = "libx264") -> Iterator[np.ndarray]:
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt, context.framerate = 128, 96, "yuv420p", FPS
    context.options = {"bf": "0", "tune": "zerolatency", "crf": "8", "g": "5"}
    for rgb in [*PICTURES, None]:
        frame = None if rgb is None else av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        for packet in context.encode(frame):
            yield np.frombuffer(bytes(packet), np.uint8)


def make_wrenches() -> tuple[str, list[tuple[float, Any]]]:
    kind = "geometry_msgs/msg/WrenchStamped"
    return kind, [(s, T[kind](header=head(s), wrench=wrench(s))) for s in np.arange(0, 0.4, 0.01).tolist()]


def check_forces(intake: importer_registry.Intake) -> None:
    s = np.arange(0, 0.4, 0.01)
    np.testing.assert_allclose(intake.force_s - START, s, atol=1e-5)
    np.testing.assert_allclose(intake.force, np.stack([0 * s, -0.5 * s, 1 + 0 * s], 1), atol=1e-9)


def find_nearest(intake: importer_registry.Intake) -> list[int]:
    return [int(np.argmin([np.abs(a.astype(int) - b).mean() for b in PICTURES])) for a in intake.pictures()]


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_without_its_metadata(plugin: StoragePlugin, tmp_path: Path) -> None:
    source = bag(tmp_path / "bag", {"/cam/image/compressed": jpegs(), "/ft": make_wrenches()}, plugin)
    (source / "metadata.yaml").unlink()
    for bag_path in (source, next(path for path in source.iterdir())):
        intake = importer_registry.read_source(bag_path)
        assert find_nearest(intake) == [*range(COUNT)]
        check_forces(intake)


@pytest.mark.parametrize("kind", ["foxglove_msgs/msg/CompressedVideo", "sensor_msgs/msg/CompressedImage"])
def test_packets_of_a_video_as_messages(kind: str, tmp_path: Path) -> None:
    time_field = {"timestamp": stamp} if "foxglove" in kind else {"header": head}
    ((field, make),) = time_field.items()
    extra_fields = {"frame_id": ""} if "foxglove" in kind else {}
    messages = [
        (k / FPS, T[kind](**{field: make(k / FPS)}, data=data, format="h264", **extra_fields))
        for k, data in enumerate(packets())
    ]
    intake = importer_registry.read_source(
        bag(tmp_path / "a", {"/video": (kind, messages), "/ft": make_wrenches()})
    )
    assert find_nearest(intake) == [*range(COUNT)]
    assert intake.times_s - START == pytest.approx(np.arange(COUNT) / FPS, abs=1e-5)
    # Recorded from between two key frames on: the first pictures can't be decoded, and are no others' times.
    late_intake = importer_registry.read_source(bag(tmp_path / "b", {"/video": (kind, messages[2:])}))
    assert find_nearest(late_intake) == [*range(5, COUNT)]
    assert late_intake.times_s - START == pytest.approx(np.arange(5, COUNT) / FPS, abs=1e-5)


def test_forces_inside_other_messages(tmp_path: Path) -> None:
    temperature = T["sensor_msgs/msg/Temperature"](header=head(0), temperature=20.0, variance=0.0)
    kind, layout = "device_msgs/msg/Reading", T["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    device = [
        (s, T[kind](header=head(s), saturated=False, wrench=message, temperature=temperature))
        for s, message in make_wrenches()[1]
    ]
    array = "std_msgs/msg/Float64MultiArray"
    numbers = [
        (s, T[array](layout=layout, data=np.array([0, -0.5 * s, 1, 9, 9, 9.0])))
        for s in np.arange(0, 0.4, 0.01).tolist()
    ]
    pair_kind = "device_msgs/msg/Two"
    pairs = [(0.1, T[pair_kind](left=wrench(0), right=wrench(0)))]
    topics: Topics = {
        "/cam": jpegs(), "/device": (kind, device), "/array": (array, numbers), "/two": (pair_kind, pairs)
    }  # fmt: skip
    source = bag(tmp_path / "bag", topics)
    check_forces(importer_registry.read_source(source))
    check_forces(importer_registry.read_source(source, {"force": "/device"}))
    check_forces(importer_registry.read_source(source, {"force": "/array"}))
    for topic in ("/two", "/cam", "/nowhere"):
        with pytest.raises(UserError, match=re.escape("/device")):
            importer_registry.read_source(source, {"force": topic})
    lone_intake = importer_registry.read_source(
        bag(tmp_path / "lone", {"/cam": jpegs(), "/array": (array, numbers)})
    )
    assert len(lone_intake.force) == 0
    assert any("/array (std_msgs/msg/Float64MultiArray)" in note for note in lone_intake.notes)


def test_a_bag_cut_off_is_named_with_its_cure(tmp_path: Path) -> None:
    data = next(bag(tmp_path / "bag", {"/cam": jpegs()}).glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match="mcap recover"):
        importer_registry.read_source(tmp_path / "cut.mcap")


@pytest.mark.parametrize(
    ("name", "content", "hint"),
    [
        ("a.bag.active", b"#ROSBAG V2.0", "rosbag reindex"),
        ("a.db3.zstd", b"\x28\xb5\x2f\xfd00", "zstd -d"),
        ("a.tdms", b"TDSm", "CSV"),
        ("a.mxf", b"\x06\x0e\x2b\x34", "ffmpeg"),
        ("a.h264", b"\0\0\0\1g", "ffmpeg"),
        ("a.csv", b"t,fx\n", "--use force"),
        ("a.mp4.part", b"0000ftyp", "not ended"),
        ("a.xyz", b"hello", "hello"),
        ("a.xyz", b"\x89MCAP0\r\n", ".mcap"),
        ("a.mha", b"\x89HDF\r\n\x1a\n", r"HDF"),
        ("a.h5", b"\x93NUMPY", ".npy"),
        ("a.npy", b"plain text", "plain text"),
        ("a.dcm", b"plain text", "DICOM"),
    ],
)
def test_an_unknown_file_is_named_with_what_it_is(
    name: str, content: bytes, hint: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=hint) as caught:
        importer_registry.read_source(tmp_path / name)
    assert "wrong ending" not in str(caught.value)


def test_stated_units_are_not_applied_twice(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.stack(PICTURES))
    rows = "".join(f"{k / 10},1,2,3\n" for k in range(9))
    (tmp_path / "f.csv").write_text("t,Fx (mN),Fy (mN),Fz (mN)\n" + rows)
    intake = importer_registry.read_source(
        tmp_path / "v.npy", {"fps": "25", "force": str(tmp_path / "f.csv")}
    )
    assert intake.force[0] == pytest.approx([1e-3, 2e-3, 3e-3])
    with pytest.raises(UserError, match="newtons"):
        importer_registry.write_recording(intake, tmp_path / "out", 0.001, {}, lambda done: None)
    (tmp_path / "f.csv").write_text("t,Fz\n" + "".join(f"{k / 10},{k}\n" for k in range(9)))
    intake = importer_registry.read_source(
        tmp_path / "v.npy", {"fps": "25", "force": str(tmp_path / "f.csv")}
    )
    importer_registry.write_recording(intake, tmp_path / "out", 0.001, {}, lambda done: None)
    assert (tmp_path / "out/force.csv").read_text().splitlines()[:3] == ["t_s,fz_n", "0.000000,0.000000000",
                                                                        "0.100000,0.001000000"]  # fmt: skip


def dicom(path: Path, syntax: str, pixels: Any, **about: object) -> Path:
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.encaps import encapsulate
    from pydicom.uid import UID

    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = UID(syntax)
    dataset.file_meta.MediaStorageSOPClassUID = dataset.SOPClassUID = "1.2.840.10008.5.1.4.1.1.77.1.1.1"
    dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID = "1.2.3"
    dataset.Rows, dataset.Columns, dataset.NumberOfFrames = 96, 128, COUNT
    dataset.SamplesPerPixel, dataset.PlanarConfiguration, dataset.PhotometricInterpretation = 3, 0, "RGB"
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit, dataset.PixelRepresentation = 8, 8, 7, 0
    for key, value in about.items():
        setattr(dataset, key, value)
    is_raw = isinstance(pixels, np.ndarray)
    dataset.PixelData = pixels.tobytes() if is_raw else encapsulate([pixels])
    dataset["PixelData"].is_undefined_length = not is_raw
    dataset.save_as(path, enforce_file_format=True)
    return path


def test_dicom_of_frames_and_of_a_video(tmp_path: Path) -> None:
    pytest.importorskip("pydicom")
    source = dicom(tmp_path / "a.dcm", "1.2.840.10008.1.2.1", np.stack(PICTURES), FrameTime="40")
    intake = importer_registry.read_source(source)
    assert np.array_equal(np.stack(list(intake.pictures())), np.stack(PICTURES))
    assert intake.times_s == pytest.approx(np.arange(COUNT) / FPS)
    with pytest.raises(UserError, match="without times"):
        importer_registry.read_source(dicom(tmp_path / "b.dcm", "1.2.840.10008.1.2.1", np.stack(PICTURES)))
    with av.open(str(tmp_path / "v.ts"), "w") as out:
        stream = out.add_stream("libx264", rate=FPS, options={"crf": "8", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = 96, 128, "yuv420p"
        for rgb in PICTURES:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")))
        out.mux(stream.encode(None))
    video_source = dicom(tmp_path / "c.dcm", "1.2.840.10008.1.2.4.102", (tmp_path / "v.ts").read_bytes())
    intake = importer_registry.read_source(video_source)
    assert find_nearest(intake) == [*range(COUNT)]
    assert intake.times_s == pytest.approx(np.arange(COUNT) / FPS, abs=1e-4)


def test_dicom_of_a_video_of_inverted_grey(tmp_path: Path) -> None:
    pytest.importorskip("pydicom")
    with av.open(str(tmp_path / "v.ts"), "w") as out:
        stream = out.add_stream("libx264", rate=FPS, options={"crf": "4", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = 96, 128, "yuv420p"
        for rgb in PICTURES:
            negative = np.repeat(255 - rgb[..., 1:2], 3, axis=2)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(negative, format="rgb24")))
        out.mux(stream.encode(None))
    about = {"PhotometricInterpretation": "MONOCHROME1", "SamplesPerPixel": 1}
    data = (tmp_path / "v.ts").read_bytes()
    source = dicom(tmp_path / "c.dcm", "1.2.840.10008.1.2.4.102", data, **about)
    grey = np.stack(list(importer_registry.read_source(source).pictures()))[..., 1].astype(int)
    assert np.abs(grey - np.stack(PICTURES)[..., 1]).mean() < 4


@pytest.mark.parametrize("bits", [8, 12])
def test_dicom_of_inverted_grey(bits: int, tmp_path: Path) -> None:
    pytest.importorskip("pydicom")
    dark = np.stack([picture[..., 1] for picture in PICTURES]).astype("<u2" if bits > 8 else "u1")
    about = {"SamplesPerPixel": 1, "BitsAllocated": 8 if bits == 8 else 16, "BitsStored": bits}
    about |= {"HighBit": bits - 1, "FrameTime": "40", "PhotometricInterpretation": "MONOCHROME1"}
    values = ((1 << bits) - 1) - (dark << (bits - 8))
    source = dicom(tmp_path / "a.dcm", "1.2.840.10008.1.2.1", values.astype(dark.dtype), **about)
    grey = np.stack(list(importer_registry.read_source(source).pictures()))[..., 0].astype(int)
    np.testing.assert_allclose(grey, dark, atol=1)


def test_dicom_of_a_palette(tmp_path: Path) -> None:
    pytest.importorskip("pydicom")
    index = np.stack([picture[..., 1] for picture in PICTURES]).astype(np.uint8)
    colours = np.random.default_rng(0).integers(0, 256, (256, 3))
    colours[0] = 255
    about: dict[str, object] = {"SamplesPerPixel": 1, "PhotometricInterpretation": "PALETTE COLOR"}
    for name, column in zip(("Red", "Green", "Blue"), colours.T, strict=True):
        about[f"{name}PaletteColorLookupTableDescriptor"] = [256, 0, 16]
        about[f"{name}PaletteColorLookupTableData"] = (257 * column).astype("<u2").tobytes()
    source = dicom(tmp_path / "a.dcm", "1.2.840.10008.1.2.1", index, FrameTime="40", **about)
    np.testing.assert_allclose(
        np.stack(list(importer_registry.read_source(source).pictures())).astype(int), colours[index], atol=1
    )


def test_a_folder_of_neither_is_named_with_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "notes.md").write_text("x")
    with pytest.raises(UserError, match=r"notes\.md"):
        importer_registry.read_source(tmp_path)
    shutil.rmtree(tmp_path)
