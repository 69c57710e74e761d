"""Importers return the frames, times and forces that each format's own library wrote."""

from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run
from fake_recording import texture
from numpy.typing import NDArray

from bench.cli import app
from bench.importers import importer_registry
from bench.importers.import_formats import IMPORTERS
from bench.recording.recording_folder import open_recording
from synth.errors import UserError
from tests.bench.importers.test_stereo_bag import open_bag

TIMES = np.array([0.0, 0.11, 0.19, 0.3])
FORCE = np.array([[0.0, 0, 0], [0.1, 0, -0.2], [0.2, 0.1, 0], [0.0, 0, 0.05]])


def footage() -> NDArray[np.uint8]:
    """(4, 12, 16, 3), smooth enough to survive a change of colour space within two levels."""
    y, x = np.mgrid[:12, :16]
    shades = [[60 + 8 * x, 90 + 6 * y, 120 + 20 * k + 0 * x] for k in range(4)]
    return np.moveaxis(np.array(shades, np.uint8), 1, -1)


def igs(path: Path) -> Path:
    lines = ["ObjectType = Image", "NDims = 3", "DimSize = 16 12 4", "ElementType = MET_UCHAR",
             "ElementNumberOfChannels = 3", "UltrasoundImageOrientation = MF"]  # fmt: skip
    for k in range(4):
        lines += [
            f"Seq_Frame{k:04d}_Timestamp = {TIMES[k]}",
            f"Seq_Frame{k:04d}_Force = {' '.join(map(str, FORCE[k]))}",
            f"Seq_Frame{k:04d}_StylusTipToWorldTransformStatus = OK",
        ]
    head = "\n".join([*lines, "ElementDataFile = LOCAL", ""])
    path.write_bytes(head.encode() + footage().tobytes())
    return path


def hdf5(path: Path) -> Path:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(path, "w") as file:
        file["camera/rgb"] = footage()
        file["camera/timestamps"] = TIMES
        file["sensor/force"] = FORCE
        file["sensor/force_time"] = TIMES
        file["tip"] = FORCE
    return path


LATE_S = 1e6  # offset of the bag's own clock


def mcap(path: Path, unstamped_topic: str = "") -> Path:
    """A ROS 2 bag folder; the topic `unstamped_topic` has no times of its own."""
    with open_bag(path) as (kind, put):
        vector = kind["geometry_msgs/msg/Vector3"]
        for time_s, picture, newtons in zip(TIMES, footage(), FORCE, strict=True):
            bgr = np.ascontiguousarray(picture[..., ::-1]).ravel()
            force = kind["geometry_msgs/msg/Wrench"](vector(*newtons), vector(0.0, 0.0, 0.0))
            for topic, name, values in (
                ("/camera", "sensor_msgs/msg/Image", (12, 16, "bgr8", 0, 48, bgr)),
                ("/ft", "geometry_msgs/msg/WrenchStamped", (force,)),
            ):
                put(topic, name, LATE_S + time_s, *values, stamp_s=0 if topic == unstamped_topic else time_s)
            put("/tip", "geometry_msgs/msg/Point", LATE_S + time_s, 1.0, 2.0, 3.0)
    return path


@pytest.mark.parametrize(
    ("make", "name", "use"),
    [(igs, "run.igs.mha", []), (hdf5, "run.h5", ["--use", "frames=camera/rgb"]), (mcap, "run", [])],
)
def test_imported_data_equal_the_source(
    make: Callable[[Path], Path], name: str, use: list[str], tmp_path: Path
) -> None:
    source, out = make(tmp_path / name), tmp_path / "rec"
    run(app, "import", source, "-o", out, "--scale", 0.1, *use)
    recording = open_recording(out)
    pictures = list(recording.frames())
    assert np.array([p.time_s for p in pictures]) == pytest.approx(TIMES, abs=1e-6)
    rgb = np.stack([p.rgb for p in pictures]).astype(int)
    assert np.abs(rgb - footage()).max() <= 3  # RGB to YUV and back
    assert recording.force.force_mn == pytest.approx(1000 * FORCE, abs=1e-6)


def test_the_bags_clock_is_used_only_for_topics_without_stamps(tmp_path: Path) -> None:
    """A single zero stamp, as the first of a simulated clock, is valid."""
    intake = importer_registry.read_source(mcap(tmp_path / "bag", unstamped_topic="/ft"))
    assert intake.times_s == pytest.approx(TIMES)
    assert intake.force_s == pytest.approx(LATE_S + TIMES)


def write_nonsense(path: Path) -> Path:
    path.write_text("nothing of the kind")
    return path


@pytest.mark.parametrize(
    ("make", "name", "use"),
    [
        (write_nonsense, "a.h5", {}),
        (write_nonsense, "a.xyz", {}),
        (hdf5, "a.h5", {"force": "camera/timestamps"}),
        (igs, "a.mha", {"nonsense": "x"}),
    ],
)
def test_unreadable_sources_are_refused(
    make: Callable[[Path], Path], name: str, use: dict[str, str], tmp_path: Path
) -> None:
    with pytest.raises(UserError):
        importer_registry.read_source(make(tmp_path / name), use)


def test_a_format_of_another_package_is_read_by_its_ending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(IMPORTERS, "_added", {})
    pictures = [np.full((16, 20, 3), 10 * k, np.uint8) for k in range(3)]

    def read_xyz(source: Path, use: Mapping[str, str]) -> object:
        return importer_registry.Intake(np.arange(3) / 25, lambda: iter(pictures)) if not use else None

    IMPORTERS.add("xyz", read_xyz)
    intake = importer_registry.read_source(write_nonsense(tmp_path / "a.XYZ"))
    np.testing.assert_array_equal(np.stack(list(intake.pictures())), pictures)
    with pytest.raises(UserError, match="xyz"):
        importer_registry.read_source(tmp_path / "a.XYZ", {"force": "b"})


def test_truncated_sequence_leaves_nothing_behind(tmp_path: Path) -> None:
    source = igs(tmp_path / "a.mha")
    source.write_bytes(source.read_bytes()[:-700])
    with pytest.raises(UserError):
        importer_registry.write_recording(
            importer_registry.read_source(source), tmp_path / "rec", 1.0, {}, lambda done: None
        )
    assert not any(path.name.startswith("rec") for path in tmp_path.iterdir())


VIDEO = np.stack([texture(48, 64, seed) for seed in range(12)])


def test_a_folder_of_pictures_with_a_ros_table_becomes_a_recording(tmp_path: Path) -> None:
    pictures = tmp_path / "cam"
    pictures.mkdir()
    for k, rgb in enumerate(VIDEO):
        cv2.imwrite(str(pictures / f"img{k}.png"), rgb[..., ::-1])  # img10 comes after img9
    table = tmp_path / "ft.csv"
    rows = "\n".join(f"{(17 * 10**8 + k) * 10**9},{k},{0.1 * k},0,-0.5" for k in range(4))
    table.write_text(
        f"%time,field.header.seq,field.wrench.force.x,field.wrench.force.y,field.wrench.force.z\n{rows}\n"
    )
    stamps = tmp_path / "stamps.csv"
    stamps.write_text("\n".join(["t_s", *(f"{1.7e9 + k / 4:.3f}" for k in range(12))]) + "\n")
    out = tmp_path / "rec"
    times = ["--use", f"force={table}", "--use", f"frame_time={stamps}"]
    run(app, "import", pictures, "-o", out, "--scale", 0.1, *times)
    recording = open_recording(out)
    assert recording.force.time_s == pytest.approx([0, 1, 2, 3], abs=1e-5)
    assert recording.force.force_mn[3] == pytest.approx([300.0, 0.0, -500.0])
    frames = list(recording.frames())
    assert [frame.time_s for frame in frames] == pytest.approx(np.arange(12) / 4, abs=1e-5)
    for frame, rgb in zip(frames, VIDEO, strict=True):
        assert np.abs(frame.rgb.astype(int) - rgb).max() <= 4


def test_a_fast_sensor_that_is_not_in_seconds_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "video.npy", VIDEO)
    table = tmp_path / "ft.csv"

    def read(seconds: float, ticks_per_s: float) -> importer_registry.Intake:
        rows = [f"{ticks_per_s * k / 1000:.6f},0,0,1" for k in range(int(seconds * 1000))]
        table.write_text("\n".join(["t_s,fx,fy,fz", *rows]) + "\n")
        return importer_registry.read_source(tmp_path / "video.npy", {"fps": "25", "force": str(table)})

    for unit in (1e3, 1e6):
        with pytest.raises(UserError, match="seconds"):
            read(1, unit)
    assert len(read(1, 1).force) == 1000
    # A sensor may run for two minutes next to half a second of video.
    assert len(read(120, 1).force) == 120_000
