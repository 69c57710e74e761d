"""Calibrations of other programs: read, or refused by the name of what is not supported."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from synth.errors import UserError
from synth.flow.stereo.calibration import read_rig
from synth.render.camera import camera_calibration
from synth.system.camera_file import describe, find_baseline_mm, read_lens

K = [[800.0, 0.0, 320.5], [0.0, 801.0, 238.5], [0.0, 0.0, 1.0]]
D = [-0.2, 0.05, 0.001, -0.002, 0.01]
FLAT = [x for row in K for x in row]
TURN = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
ROS = f"""image_width: 640
image_height: 480
camera_matrix: {{rows: 3, cols: 3, data: {FLAT}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {D}}}
"""
KALIBR = f"""cam0:
  camera_model: pinhole
  intrinsics: [800.0, 801.0, 320.5, 238.5]
  distortion_model: radtan
  distortion_coeffs: {D[:4]}
  resolution: [640, 480]
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.0044], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  intrinsics: [900.0, 901.0, 320.5, 238.5]
  distortion_coeffs: {D[:4]}
  resolution: [640, 480]
"""
SIDE = "Res_x=640\nRes_y=480\nfc_x=800\nfc_y=801\ncc_x=320.5\ncc_y=238.5\n"
SIDE += "".join(f"kc_{k}={x}\n" for k, x in enumerate(D))
INI = f"[StereoLeft]\n{SIDE}[StereoRight]\n{SIDE}T_0=-4.4\nT_1=0\nT_2=0\n"
INI += "".join(f"R_{k}={x}\n" for k, x in enumerate(np.eye(3).ravel()))


def write_pair(**changes: object) -> str:
    return json.dumps({"K1": K, "D1": D, "K2": K, "D2": D, "R": TURN, "T": [-4.4, 0, 0], **changes})


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yaml", ROS),
        ("a.yaml", KALIBR),
        ("a.json", write_pair()),
        ("a.yaml", f"height: 480\nwidth: 640\nd: {D}\nk: {FLAT}\nroi: {{width: 0, height: 0}}\n---\n"),
        ("a.json", json.dumps({"mtx": str(np.array(K)), "dist": [D]})),
        ("a.json", json.dumps({"fx": 800, "fy": 801, "cx": 320.5, "cy": 238.5, "k1": -0.2, "k2": 0.05})),
    ],
)
def test_one_camera_of_every_program_is_read(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    matrix, lens = read_lens(tmp_path / name, (640, 480))
    np.testing.assert_allclose(matrix, K)
    np.testing.assert_allclose(lens[:2], D[:2])


@pytest.mark.parametrize("name", ["c.yaml", "c.xml", "c.json"])
def test_what_opencv_wrote_is_read_and_another_size_of_the_same_shape_keeps_the_field(
    name: str, tmp_path: Path
) -> None:
    storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
    values = {"image_width": 640, "image_height": 480, "camera_matrix": np.array(K)}
    for key, value in (values | {"distortion_coefficients": np.array([D])}).items():
        storage.write(key, value)
    storage.release()
    for width, height in ((640, 480), (320, 240)):
        matrix, lens = camera_calibration.read(tmp_path / name, (width, height))
        np.testing.assert_allclose(lens, D)
        assert matrix[0, 0] == pytest.approx(K[0][0] * width / 640)
        # The corner of the picture, half a pixel outside the first centre, is where it was.
        assert (-0.5 - matrix[0, 2]) / matrix[0, 0] == pytest.approx((-0.5 - K[0][2]) / K[0][0])
    with pytest.raises(UserError):
        camera_calibration.read(tmp_path / name, (640, 360))


@pytest.mark.parametrize(("name", "text", "right"), [("a.yaml", KALIBR, 900), ("a.ini", INI, 800)])
def test_a_pair_is_read_and_scaled_to_the_pictures(
    name: str, text: str, right: float, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    rig = read_rig(tmp_path / name, (320, 240))
    assert (rig.left.K[0, 0], rig.right.K[0, 0], rig.left.K[0, 2]) == (400, right / 2, 160)
    np.testing.assert_allclose(rig.translation, [-4.4, 0, 0])


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        (ROS.replace("plumb_bob", "equidistant"), "equidistant"),
        (KALIBR.replace("pinhole", "omni"), "omni"),
        (write_pair(fisheye_model=1), "fisheye_model"),
        (write_pair(thin_prism_coefficients=[0.1, 0.1]), "thin_prism"),
        (write_pair(K1=np.transpose(K).tolist()), "319.5, 237.5"),
        (write_pair(R=(1.1 * np.eye(3)).tolist()), "not a rotation"),
        (write_pair(D1=[0, 0, 0, 0, 0, 1]), "6 distortion coefficients"),
        (write_pair(K1=[[1800, 0, 960], [0, 1800, 540], [0, 0, 1]]), "960, 540"),
        (write_pair(D2=[-0.2, 0.05, 0.08, 0.001, 0.002]), "0.08"),
        (write_pair(T=[-0.0044, 0, 0]), "mm_per_unit.*1000"),
        (write_pair(image_size=[1920, 1080]), "1920 x 1080"),
        ('{"a": ' + "[" * 500_000, "recursion"),
    ],
)
def test_what_is_not_supported_is_named(text: str, pattern: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(UserError, match=pattern) as error:
        read_rig(tmp_path / "a.yaml", (640, 480))
    assert "\n" not in str(error.value)


def test_the_baseline_is_that_of_a_pair_also_of_equal_cameras(tmp_path: Path) -> None:
    lone_camera = json.dumps({"K": K, "D": D, "R": TURN, "T": [-4.4, 0, 0]})
    file, pair_files = tmp_path / "a.json", (write_pair(), write_pair().replace('"K', '"M'), KALIBR)
    for text, baseline_mm in (
        *((content, 4.4) for content in pair_files),
        (lone_camera, 0.0),
        ("damaged", 0.0),
    ):
        file.write_text(text)
        assert find_baseline_mm(file) == pytest.approx(baseline_mm)


def test_one_camera_in_two_resolutions_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.ini").write_text("[LEFT_HD]\nfx=700\nfy=700\ncx=640\ncy=360\n[LEFT_VGA]\nfx=350\n")
    with pytest.raises(UserError, match="fx"):
        read_lens(tmp_path / "a.ini", (1280, 720))


FX, FY, CX, CY = K[0][0], K[1][1], K[0][2], K[1][2]
SPLIT = {"RadialDistortion": D[:2], "TangentialDistortion": D[2:4], "ImageSize": [480, 640]}
MATLAB = {"IntrinsicMatrix": np.transpose([[FX, 0, CX + 1], [0, FY, CY + 1], [0, 0, 1]]).tolist(), **SPLIT}
OST = f"""# oST version 5.0 parameters

[image]

width
640

height
480

[narrow_stereo]

camera matrix
{FX} 0.0 {CX}
0.0 {FY} {CY}
0.0 0.0 1.0

distortion
{" ".join(map(str, D))}
"""
METASHAPE = f"""<?xml version='1.0'?><calibration><projection>frame</projection><width>640</width>
<height>480</height><f>{FX}</f><cx>{CX - 319.5}</cx><cy>{CY - 239.5}</cy><k1>{D[0]}</k1><k2>{D[1]}</k2>
<k3>{D[4]}</k3><p1>{D[3]}</p1><p2>{D[2]}</p2></calibration>"""
NERF = {"fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5, "w": 640, "h": 480, "frames": []}
TERMS = dict(zip(("k1", "k2", "p1", "p2"), D, strict=False))
PRINTED = f"[ 640x480  p[{CX} {CY}]  f[{FX} {FY}]  Inverse Brown Conrady [0 0 0 0 0] ]"


@pytest.mark.parametrize(
    ("text", "lens"),
    [
        (json.dumps(NERF | TERMS), D[:4]),
        (
            f"# Camera list\n1 OPENCV 640 480 {FX} {FY} {CX + 0.5} {CY + 0.5} {' '.join(map(str, D[:4]))}\n",
            D[:4],
        ),
        (METASHAPE, D),
        (OST, D),
        ("\n".join(" ".join(f"{x:.8e}" for x in row) for row in K), []),
        (json.dumps(MATLAB), D[:4]),
        (json.dumps(SPLIT | {"K": [[FX, 0, CX + 1], [0, FY, CY + 1], [0, 0, 1]]}), D[:4]),
        (f"camera_matrix: {K}\nradial: {D[:2]}\ntangential: {D[2:4]}\n", D[:4]),
        (f"camera_matrix: {K}\nradial_distortion: {[*D[:2], D[4]]}\n", [*D[:2], 0, 0, D[4]]),
        (f"camera_matrix: {K}\n", []),
        (PRINTED, []),
        (f"camera_matrix: {K}\ndist_coeffs: {D}\nimg_shape: [480, 640]\n", D),
        (json.dumps({"P1": [[FX, 0, CX, 0], [0, FY, CY, 0], [0, 0, 1, 0]]}), []),
    ],
)
def test_cameras_of_further_programs_are_read(text: str, lens: list[float], tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text)
    matrix, distortion = read_lens(tmp_path / "a.txt", (640, 480))
    # Metashape states one focal length.
    np.testing.assert_allclose(matrix[[0, 0, 1], [0, 2, 2]], [FX, CX, CY], atol=1e-6)
    np.testing.assert_allclose(distortion, [*lens, *[0.0] * (len(distortion) - len(lens))], atol=1e-9)
    assert bool(describe(tmp_path / "a.txt")) == (not lens and text != PRINTED)


POSE = "T_BS: {{cols: 4, rows: 4, data: [1, 0, 0, {}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}}, "
EUROC = "".join(
    f"cam{k}: {{{POSE.format(x)}resolution: [640, 480], intrinsics: [{FX}, {FY}, {CX}, {CY}], "
    f"distortion_coefficients: {D[:4]}}}\n"
    for k, x in enumerate((0.0, 0.0044))
)
BOTH = {f"CameraParameters{k}": MATLAB for k in (1, 2)}
TILT = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0]


@pytest.mark.parametrize(
    ("text", "turn"),
    [
        (EUROC, np.eye(3)),
        (json.dumps(BOTH | {"PoseCamera2": {"R": TILT.tolist(), "Translation": [-4.4, 0, 0]}}), TILT),
        (
            json.dumps(BOTH | {"RotationOfCamera2": TILT.T.tolist(), "TranslationOfCamera2": [-4.4, 0, 0]}),
            TILT,
        ),
        (
            json.dumps(
                {f"P{k}": [[FX, 0, CX, x], [0, FY, CY, 0], [0, 0, 1, 0]] for k, x in ((1, 0), (2, -4.4 * FX))}
            ),
            np.eye(3),
        ),
    ],
)
def test_pairs_of_further_programs_are_read(text: str, turn: np.ndarray, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    rig = read_rig(tmp_path / "a.yaml", (640, 480))
    np.testing.assert_allclose(rig.translation, [-4.4, 0, 0], atol=1e-9)
    np.testing.assert_allclose(rig.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(rig.right.K[0], [FX, 0, CX], atol=1e-9)


def test_a_region_and_binning_of_the_sensor_are_heeded(tmp_path: Path) -> None:
    roi = "binning_x: 2\nbinning_y: 2\nroi: {x_offset: 200, y_offset: 100, height: 360, width: 400}\n"
    (tmp_path / "a.yaml").write_text(ROS + roi)
    matrix, _ = read_lens(tmp_path / "a.yaml", (200, 180))
    # A pixel of the picture is two of the sensor, and its corner is at the region's.
    np.testing.assert_allclose(matrix[[0, 1], [0, 1]], [FX / 2, FY / 2])
    np.testing.assert_allclose(matrix[:2, 2], [(CX + 0.5 - 200) / 2 - 0.5, (CY + 0.5 - 100) / 2 - 0.5])
    with pytest.raises(UserError, match="200 x 180"):
        read_lens(tmp_path / "a.yaml", (640, 480))


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("1 OPENCV_FISHEYE 640 480 800 801 320 240 0 0 0 0\n", "OPENCV_FISHEYE"),
        ("1 PINHOLE 640 480 800 801 320 240\n2 PINHOLE 640 480 800 801 320 240\n", "2 cameras"),
        (METASHAPE.replace("frame<", "fisheye<"), "fisheye"),
        (PRINTED.replace("[0 0", "[0.1 0"), "Inverse"),
        ("[LEFT_CAM_HD]\nfx=700\n[STEREO]\nBaseline=120\n", "ZED"),
        (f"camera_matrix: {K}\ndistortion: [-0.3, 0.1, 0.02, 0.0004, -0.0007]\n", "k3"),
        (json.dumps({"fx": 0.9, "fy": 1.2, "cx": 0.5, "cy": 0.5}), "multiply"),
        (write_pair(T=[1e150, 0, 0]), "T of"),
        (write_pair(K1=[[1e150, 0, 320], [0, 1e150, 240], [0, 0, 1]]), "e\\+150"),
    ],
)
def test_further_models_and_numbers_are_refused_by_name(text: str, pattern: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(UserError, match=pattern):
        read_rig(tmp_path / "a.json", (640, 480))
