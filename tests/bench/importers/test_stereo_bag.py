"""A bag as surgical robots record them: two compressed cameras, two wrenches, calibrations."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from command import run
from scipy.spatial.transform import Rotation

from bench.cli import app
from bench.importers import importer_registry
from bench.importers.rosbag import _depth, _read_lens, partners
from bench.recording.recording_folder import open_recording
from synth.errors import UserError
from synth.flow.stereo.calibration import read_rig

SIZE, FPS, FOCAL, BASE_MM, AWAY_MM = (320, 180), 10.0, 1000.0, 5.0, 100.0
CAMERAS = {side: f"/davinci/{side}/camera/image_raw/compressed" for side in ("left", "right")}
DEPTH = "/davinci/depth/image"
ARMS = ("/PSM1/body/measured_cf", "/PSM2/body/measured_cf")
LATE_S = 0.012  # delay of the right camera's stamps
K = np.array([[FOCAL, 0, 157.0], [0, FOCAL, 93], [0, 0, 1]])
TOED_IN = Rotation.from_rotvec([0.002, -0.03, 0.004]).as_matrix(), np.array([-BASE_MM, 0.1, -0.2])
PARALLEL = np.eye(3), np.array([-BASE_MM, 0, 0])


def lenses(pair: tuple[np.ndarray, np.ndarray], distortions: list[np.ndarray]) -> dict[str, dict[str, Any]]:
    """What ROS's `camera_calibration` writes for a pair: OpenCV's rectification, with lengths in metres."""
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K, distortions[0], K, distortions[1], SIZE, pair[0], pair[1][:, None] / 1000
    )
    parts = zip(CAMERAS, distortions, (R1, R2), (P1, P2), strict=True)
    return {camera: {"k": K.ravel(), "d": d, "r": R.ravel(), "p": P.ravel()} for camera, d, R, P in parts}


@contextmanager
def open_bag(path: Path) -> Iterator[tuple[Any, Callable[..., None]]]:
    """Types of messages, and a function that writes one; without `stamp_s` its type has no header."""
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind, connections = store.types, dict[str, Any]()

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:

        def put(topic: str, name: str, time_s: float, *values: Any, stamp_s: float | None = None) -> None:
            stamp = kind["builtin_interfaces/msg/Time"](*divmod(round(1e9 * (stamp_s or 0)), 10**9))
            head = () if stamp_s is None else (kind["std_msgs/msg/Header"](stamp, ""),)
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, name, typestore=store)
            message = kind[name](*head, *values)
            bag.write(connections[topic], round(1e9 * time_s), store.serialize_cdr(message, name))

        yield kind, put


def write_bag(
    path: Path,
    video: list[dict[str, np.ndarray]],
    force_n: np.ndarray,
    infos: dict[str, dict[str, Any]],
    depths: tuple[np.ndarray, ...] = (),
) -> Path:
    """Pictures (H, W, 3) of the cameras, PSM1's force (N, 3) at 10 samples per frame; PSM2's is 0."""
    with open_bag(path) as (kind, write):

        def put(topic: str, name: str, time_s: float, *values: Any) -> None:
            write(topic, name, time_s, *values, stamp_s=time_s)

        for camera, topic in CAMERAS.items():
            roi = kind["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            info = (SIZE[1], SIZE[0], "plumb_bob", *(infos[camera][name] for name in "dkrp"), 0, 0, roi)
            put(f"/davinci/{camera}/camera/camera_info", "sensor_msgs/msg/CameraInfo", 0.0, *info)
            for t, pictures in enumerate(video):
                if camera not in pictures:
                    continue
                jpeg = cv2.imencode(".jpg", pictures[camera][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
                delay_s = LATE_S * (camera == "right")
                put(topic, "sensor_msgs/msg/CompressedImage", 1 + t / FPS + delay_s, "jpeg", jpeg)
        for t, depth in enumerate(depths):
            rows = (*depth.shape, {"u": "16UC1", "f": "32FC1"}[depth.dtype.kind], 0, depth.strides[0])
            put(DEPTH, "sensor_msgs/msg/Image", 1 + t / FPS, *rows, depth.view(np.uint8).ravel())
        vector = kind["geometry_msgs/msg/Vector3"]
        for arm, topic in enumerate(ARMS):
            for k, newtons in enumerate(force_n):
                parts = vector(*(newtons * (arm == 0))), vector(0.0, 0.0, 0.0)
                wrench = kind["geometry_msgs/msg/Wrench"](*parts)
                put(topic, "geometry_msgs/msg/WrenchStamped", 1 + k / FPS / 10, wrench)
    return path


@pytest.mark.parametrize(
    ("sensor", "corner", "part", "binning"),
    [((640, 400), (80, 20), (320, 180), (1, 1)), ((640, 360), (0, 0), (0, 0), (2, 2)),
     ((1280, 720), (100, 60), (640, 360), (2, 2)), ((640, 180), (0, 0), (0, 0), (2, 1))],
)  # fmt: skip
@pytest.mark.parametrize("name", ["image_raw", "image_rect_color"])
def test_a_region_of_the_sensor_and_binning_are_heeded(
    sensor: tuple[int, int],
    corner: tuple[int, int],
    part: tuple[int, int],
    binning: tuple[int, int],
    name: str,
) -> None:
    """A point of the scene is where the sensor's pixel that shows it went."""
    area = SimpleNamespace(x_offset=corner[0], y_offset=corner[1], width=part[0], height=part[1])
    P = np.column_stack([K, [-FOCAL * 0.004, 0, 0]])
    calibration = {"k": K.ravel(), "d": np.zeros(5), "r": np.eye(3).ravel(), "p": P.ravel()}
    about = {"width": sensor[0], "height": sensor[1], "distortion_model": "plumb_bob", "roi": area}
    info = SimpleNamespace(**calibration, **about, binning_x=binning[0], binning_y=binning[1])
    lens = _read_lens("camera_info", info, f"/cam/{name}", SIZE)
    point = np.array([0.02, -0.01, 1.0])
    pixel = (K @ point)[:2]  # centres of the sensor's pixels are whole numbers
    expected = (pixel - corner + 0.5) / binning - 0.5
    np.testing.assert_allclose((lens.K @ point)[:2], expected, atol=1e-9)
    assert lens.shift_mm == pytest.approx(-4)
    with pytest.raises(UserError, match=r"binning|calibrated"):
        _read_lens("camera_info", info, f"/cam/{name}", sensor)


def test_stereo_pictures_and_calibration_equal_the_bags(tmp_path: Path) -> None:
    """Of six frames the right camera lacks the first, fourth and last."""
    distortions = [k * np.array([-0.3, 0.1, 0.001, -0.002, 0.05]) for k in (1.0, 0.9)]
    shape = (*SIZE[::-1], 3)
    video = [{"left": np.full(shape, 30 * t, np.uint8)} for t in range(6)]
    for t in (1, 2, 4):
        video[t]["right"] = np.full(shape, 30 * t + 9, np.uint8)
    source = write_bag(tmp_path / "bag", video, np.zeros((60, 3)), lenses(TOED_IN, distortions))
    words = ["import", source, "-o", tmp_path / "rec", "--scale", AWAY_MM / FOCAL]
    run(app, *words, "--use", f"right={CAMERAS['right']}", "--use", f"force={ARMS[0]}")
    rig = read_rig(tmp_path / "rec/stereo.yaml", SIZE)
    assert rig.rotation == pytest.approx(TOED_IN[0], abs=1e-9)
    assert rig.translation == pytest.approx(TOED_IN[1], abs=1e-9)
    for expected, lens in zip(distortions, (rig.left, rig.right), strict=True):
        assert np.array_equal(lens.K, K)
        assert np.array_equal(lens.distortion, expected)
    recording = open_recording(tmp_path / "rec")
    shades = {frame.index: int(np.median(frame.rgb)) for frame in recording.right_frames()}
    assert shades == {0: 39, 1: 69, 3: 129}, "each assigned to the frame of its time"
    frames = list(recording.frames())
    assert [int(np.median(frame.rgb)) for frame in frames] == pytest.approx([30, 60, 90, 120], abs=2)
    assert [frame.time_s for frame in frames] == pytest.approx(1 + np.arange(1, 5) / FPS, abs=1e-5)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_depth_equals_the_bags(tmp_path: Path, kind: type) -> None:
    """Millimetres in 16 bits, metres in floats."""
    depth_mm = np.add.outer(np.arange(SIZE[1]), np.arange(500, 500 + SIZE[0]))
    video = [{"left": np.zeros((*SIZE[::-1], 3), np.uint8)}]
    depth = (depth_mm / (1000 if kind is np.float32 else 1)).astype(kind)
    infos = lenses(PARALLEL, 2 * [np.zeros(5)])
    source = write_bag(tmp_path / "bag", video, np.zeros((2, 3)), infos, (depth,))
    intake = importer_registry.read_source(source, {"depth": DEPTH, "force": ARMS[0]})
    out = importer_registry.write_recording(
        intake, tmp_path / "rec", 1.0, {"scale_mm_per_px": 0.1}, lambda done: None
    )
    recording = open_recording(out)
    path = recording.depths[0]
    stored_depth = np.load(path) if kind is np.float32 else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored_depth == pytest.approx(depth_mm, abs=1e-3)
    assert (recording.meta.depth.focal_px, recording.meta.depth.centre_px) == (FOCAL, (157.0, 93.0))


def test_partners_are_each_others_nearest() -> None:
    frames = np.arange(6) / FPS
    matches = partners(frames[[0, 1, 1, 3, 5]] + [0.0, 0.01, 0.04, -0.02, 0.06], frames)
    assert matches.tolist() == [0, 1, -1, 3, -1]


LEFT, RIGHT = CAMERAS.values()
WRONG = {"right": "/nothing"}, {"right": RIGHT, "depth": LEFT}, {"frames": LEFT, "calibration": "/a"}, {}


@pytest.mark.parametrize("use", WRONG)
def test_ambiguous_or_wrong_topics_are_refused(tmp_path: Path, use: dict[str, str]) -> None:
    # Of another size than the calibration's.
    video = [{camera: np.zeros((90, 160, 3), np.uint8) for camera in CAMERAS}]
    source = write_bag(tmp_path / "bag", video, np.zeros((2, 3)), lenses(PARALLEL, 2 * [np.zeros(5)]))
    for further in ({}, {"right": CAMERAS["right"]}):
        with pytest.raises(UserError):
            importer_registry.read_source(source, {"force": ARMS[0], **further, **use})


def test_inverse_depth_is_refused() -> None:
    """`32FC1; compressedDepth` holds A / depth + B: as millimetres it would be wrong."""
    message = SimpleNamespace(format="32FC1; compressedDepth png", data=b"")
    with pytest.raises(UserError):
        _depth(Path("bag"), message)
