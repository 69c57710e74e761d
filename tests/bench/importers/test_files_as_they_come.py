"""Two cameras in one video, clocks of files, and formats of pictures, as cameras and labs write them."""

import struct
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from fake_recording import texture

from bench.importers import importer_registry, rosbag
from synth.errors import UserError
from synth.system import csv_table
from synth.video import read_video as video
from synth.video.stereo_layout import find_layout

WIDE = cv2.resize(texture(120, 200, 3), (800, 480), interpolation=cv2.INTER_CUBIC)
LEFT, RIGHT = WIDE[:, :640], WIDE[:, 12:652]


def write(
    path: Path, pictures: list[np.ndarray], codec: str = "ffv1", pixels: str = "bgr0", **options: str
) -> Path:
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], pixels
        for rgb in pictures:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")))
        out.mux(stream.encode(None))
    return path


def join(layout: str) -> list[np.ndarray]:
    if layout == "alternating":
        return 4 * [LEFT, RIGHT]
    axis = int(layout in ("side-by-side", "half-width"))
    picture = np.concatenate([LEFT, RIGHT], axis)
    if layout.startswith("half"):
        picture = picture[:, ::2] if axis else picture[::2]
    return 4 * [picture]


@pytest.mark.parametrize("layout", ["side-by-side", "top-bottom", "half-width", "half-height", "alternating"])
def test_two_cameras_in_one_video_are_recognised_and_split(layout: str, tmp_path: Path) -> None:
    source = write(tmp_path / "v.mkv", join(layout))
    notes = importer_registry.read_source(source).notes
    assert any(layout in note for note in notes)
    for order, expected in (("", (LEFT, RIGHT)), (",right-first", (RIGHT, LEFT))):
        intake = importer_registry.read_source(source, layout=layout + order)
        assert len(intake.times_s) == 4 == len(intake.second.frame)
        for read_pictures, rgb in zip((intake.pictures, intake.second.pictures), expected, strict=True):
            error = np.abs(next(read_pictures()).astype(int) - rgb).mean()
            assert error < (6 if layout.startswith("half") else 1)


def interleave(layout: str) -> np.ndarray:
    picture, is_odd = LEFT.copy(), np.indices(LEFT.shape[:2]) % 2 == 1
    masks = {"rows": is_odd[0], "columns": is_odd[1], "checkerboard": is_odd[0] != is_odd[1]}
    if layout == "anaglyph":
        picture[..., 1:] = RIGHT[..., 1:]
    else:
        picture[masks[layout]] = RIGHT[masks[layout]]
    return picture


@pytest.mark.parametrize("layout", ["rows", "columns", "checkerboard", "anaglyph"])
def test_two_cameras_in_lines_or_colours_are_recognised_and_those_in_lines_split(
    layout: str, tmp_path: Path
) -> None:
    source = write(tmp_path / "v.mkv", 4 * [interleave(layout)])
    assert find_layout(9 * [interleave(layout)]) == layout
    if layout in ("checkerboard", "anaglyph"):
        with pytest.raises(UserError, match="two cameras"):
            importer_registry.read_source(source, layout=layout)
        return
    intake = importer_registry.read_source(source, layout=layout)
    for read_pictures, rgb in ((intake.pictures, LEFT), (intake.second.pictures, RIGHT)):
        picture = next(read_pictures()).astype(int)
        # In place, to a fraction of a pixel.
        assert np.abs(picture - rgb).mean() < 6
        for axis in (0, 1):
            for step in (-1, 1):
                assert np.abs(picture - rgb).mean() < np.abs(picture - np.roll(rgb, step, axis)).mean()


def test_interlaced_fields_are_not_taken_for_two_cameras() -> None:
    pictures = [WIDE[:, 8 * k : 8 * k + 640].copy() for k in range(9)]
    for k, rgb in enumerate(pictures):
        rgb[1::2] = WIDE[1::2, 8 * k + 4 : 8 * k + 644]
    assert find_layout(pictures) == ""


def test_one_camera_is_not_taken_for_two() -> None:
    """Also mirrored, black, half black and periodic pictures."""
    board = np.repeat(255 * (np.add.outer(np.arange(480) // 40, np.arange(640) // 40) % 2)[..., None], 3, 2)
    mirror_pairs = np.hstack([LEFT, LEFT[:, ::-1]]), np.vstack([LEFT, LEFT[::-1]])
    for picture in (LEFT, *mirror_pairs, 0 * LEFT, LEFT * (np.arange(640) < 320)[:, None], board):
        assert find_layout(3 * [picture.astype(np.uint8)]) == ""


@pytest.mark.parametrize("seed", range(12))
def test_drawn_stripes_are_not_taken_for_two_cameras(seed: int) -> None:
    """Of 3 to 9 pixels a period, which beat with every second pixel."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:192, :256]
    turn, period = rng.choice([0, np.pi / 4, np.pi / 2, rng.uniform(0, np.pi)]), rng.uniform(3, 9)
    wave = np.sin(2 * np.pi * (x * np.cos(turn) + y * np.sin(turn)) / period)
    wave = np.sign(wave) if seed % 2 else wave
    picture = 128 + 80 * wave[..., None] + rng.normal(0, 3, (192, 256, 3))
    assert find_layout(3 * [np.clip(picture, 0, 255).astype(np.uint8)]) == ""


FRAMES = [np.roll(LEFT[:240, :320], 6 * k, 1) for k in range(8)]


@pytest.mark.parametrize("codec", ["a.avi libx264", "a.avi mpeg4", "a.ts libx264", "a.mpg mpeg2video"])
def test_times_start_at_0_and_rise_in_order(codec: str, tmp_path: Path) -> None:
    name, codec = codec.split()
    source = write(tmp_path / name, FRAMES, codec, "yuv420p", bf="2")
    pictures = list(video.read_video(source))
    assert [picture.time_s for picture in pictures] == pytest.approx(np.arange(8) / 25, abs=1e-6)
    indices = [
        np.argmin([np.abs(picture.rgb - frame.astype(int)).mean() for frame in FRAMES])
        for picture in pictures
    ]
    assert indices == [*range(8)]


@pytest.mark.parametrize("s", [1, -1])
@pytest.mark.parametrize("t", [1, -1])
@pytest.mark.parametrize("turned", [False, True])
def test_all_orientations_of_a_display_matrix(s: int, t: int, turned: bool, tmp_path: Path) -> None:
    a, b, c, d = (0, s, t, 0) if turned else (s, 0, 0, t)
    source = write(tmp_path / "a.mp4", [LEFT], "libx264", "yuv444p")
    data = bytearray(source.read_bytes())
    offset = data.index(b"tkhd") + 44
    # The track header's display matrix [ISO 14496-12, 8.3.2].
    data[offset : offset + 36] = struct.pack(">9i", *(v << 16 for v in (a, b, 0, c, d, 0, 0, 0, 1 << 14)))
    source.write_bytes(data)
    picture = next(video.read_video(source)).rgb.astype(int)
    assert picture.shape[:2] == LEFT.shape[:2][:: -1 if turned else 1]
    y, x = np.mgrid[: LEFT.shape[0], : LEFT.shape[1]]
    across, down = a * x + c * y, b * x + d * y
    assert np.abs(picture[down - down.min(), across - across.min()] - LEFT).mean() < 6


def test_stacks_bits_numbers_and_hidden_files(tmp_path: Path) -> None:
    cv2.imwritemulti(str(tmp_path / "s.tif"), [frame.astype(np.uint16) * 16 for frame in FRAMES])
    (tmp_path / "._s.tif").write_bytes(b"\0\5\x16\7" + bytes(100))
    intake = importer_registry.read_source(tmp_path, {"fps": "10"})
    assert np.array_equal([picture[..., ::-1] for picture in intake.pictures()], FRAMES)
    pngs = tmp_path / "p"
    pngs.mkdir()
    for k in (0, 1, 5):
        cv2.imwrite(str(pngs / f"{k}_l.png"), FRAMES[k])
    assert importer_registry.read_source(pngs, {"fps": "10"}).times_s == pytest.approx([0, 0.1, 0.5])
    for k in (0, 1):
        cv2.imwrite(str(pngs / f"{k}_r.png"), FRAMES[k])
    with pytest.raises(UserError, match=r"_l\.png"):
        importer_registry.read_source(pngs, {"fps": "10"})
    pair = importer_registry.read_source(pngs, {"fps": "10", "frames": "*_l.png", "right": "*_r.png"})
    assert pair.second.frame.tolist() == [0, 1]


def test_tables_of_forces(tmp_path: Path) -> None:
    """The stamp counts, not the arrival; blank rows are left out; units, dates and encodings are read."""
    np.save(tmp_path / "v.npy", np.zeros((3, 48, 64), np.uint8))
    for text in (
        "%time,field.header.stamp,a.force.x,a.force.y,a.force.z\n9e9,17e17,1,2,3\n9e9,17000000001e8,1,2,3",
        "time (ms);Fx (N);Fy (N);Fz (N)\n0;1;2;3\n50;;;\n100,0;1;2;3",
        "timestamp,fx,fy,fz\n2023-11-14T22:13:20Z,1,2,3\n2023-11-14 22:13:20.1,1,2,3",
        "t,fx,fy,fz\n1700000000000000,1,2,3\n1700000000100000,1,2,3",
    ):
        (tmp_path / "f.csv").write_text(text, "utf-16")
        intake = importer_registry.read_source(
            tmp_path / "v.npy", {"fps": "10", "force": str(tmp_path / "f.csv")}
        )
        assert intake.force_s - intake.force_s[0] == pytest.approx([0, 0.1], abs=1e-6)
        assert intake.force.tolist() == 2 * [[1, 2, 3]]
    (tmp_path / "f.csv").write_text("t,fx\nnoon,1\n")
    with pytest.raises(UserError, match=":2:"):
        csv_table.read_csv(tmp_path / "f.csv", ("t",))


def mosaic(rgb: np.ndarray) -> np.ndarray:
    """(H, W) as of a sensor with red in the first pixel and blue in the second one of the second row."""
    picture = rgb[..., 1].copy()
    picture[::2, ::2], picture[1::2, 1::2] = rgb[::2, ::2, 0], rgb[1::2, 1::2, 2]
    return picture


class Message:
    def __init__(self, encoding: str, data: np.ndarray) -> None:
        self.encoding, self.height, self.width, self.is_bigendian = encoding, 240, 320, 0
        self.step, self.data = data[:240].nbytes // 240 if data.ndim == 3 else data.strides[0], data.tobytes()


@pytest.mark.parametrize(
    ("encoding", "make"),
    [
        ("bayer_rggb8", mosaic),
        ("yuv422", lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_UYVY)),
        ("yuv422_yuy2", lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_YUYV)),
        ("rgb16", lambda rgb: rgb.astype(np.uint16)),
    ],
)
def test_pictures_of_bags(encoding: str, make: Callable[[np.ndarray], np.ndarray]) -> None:
    rgb = np.ascontiguousarray(FRAMES[0])
    picture = rosbag._picture(Path("bag"), Message(encoding, np.ascontiguousarray(make(rgb))))
    assert np.abs(picture.astype(int) - rgb).mean() < 8
