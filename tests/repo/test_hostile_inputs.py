"""What an attacker left, one by one, through the command line: refused in a line, and nothing is harmed."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import hostile
import numpy as np
import pytest
from fake_recording import Maker

from learn.inference.video import read_video
from synth.publish import preview_video

h5py = pytest.importorskip("h5py", reason="h5py is not installed")

Spoil = Callable[[Path], None]


@pytest.fixture(scope="module")
def guard() -> Iterator[hostile.Guard]:
    with hostile.Guard(
        "h5py", "SimpleITK", "rosbags.highlevel", "bench.importers.registry", "bench.scoring.commands"
    ) as one:
        yield one


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Maker(tmp_path_factory.mktemp("sound"))(frames=3, size=(24, 32))


def refused(answer: hostile.Answer, words: str) -> None:
    hostile.assert_told(answer)
    assert answer.code == 2, answer
    assert words in answer.error + answer.out, answer


# ---- Jobs.

ALIASES = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 10)
)
JOBS = {
    "alias bomb": (ALIASES, "stands for more than"),
    "alias of itself": ("seed: &a [*a]", "stands for what it lies in"),
    "deep": ("seed: " + "[" * 50_000, "nested deeper"),
    "deep in blocks": ("- " * 50_000, "nested deeper"),
    "large": ("# " + "x" * 300_000, "too large"),
    "many keys": ("".join(f"k{k}: 1\n" for k in range(4000)), "unknown key"),
    "huge number": ("seed: 0x" + "f" * 10_000, "too large"),
    "huge decimal": ("seed: " + "9" * 10_000, "integer string conversion"),
    "device": ("anatomy: {mesh: /dev/zero}", "no regular file"),
    "device as photo": ("appearance: {photo: /dev/zero}", "no regular file"),
    "folder": ("appearance: {photo: /}", "is a folder"),
    "pipe": ("render: {calibration: pipe}", "no regular file"),
    "hole": ("render: {calibration: hole}", "is too large"),
    "NUL": ('appearance: {photo: "a\\0b"}', "is no name of a file"),
    "nobody's home": ("appearance: {photo: ~nobody-here/a}", "is no name of a file"),
    "circle of links": ("appearance: {photo: circle}", "is no name of a file"),
    "long name": (f"appearance: {{photo: {'x' * 5000}}}", "File name too long"),
    "terminal": ('"\\e[31mred": 1', r"'\x1b[31mred'"),
    "mistyped gesture": ("fem: {gestures: [pusch]}", "did you mean 'push'"),
    "tag": ("seed: !!python/object/apply:os.system [id]", "a whole number is needed"),
}


@pytest.mark.parametrize("name", JOBS)
def test_a_job_is_refused(guard: hostile.Guard, tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    with (tmp_path / "hole").open("wb") as file:
        file.truncate(1 << 40)
    text, words = JOBS[name]
    (tmp_path / "job.yaml").write_text(text)
    answer = guard.answer("synth", "render", "job.yaml", "-o", "out", cwd=tmp_path)
    hostile.assert_told(answer, lines=21)
    assert words in answer.error
    assert answer.code == 2
    assert not (tmp_path / "out").exists()


def test_a_mistyped_gesture_is_the_only_mistake(guard: hostile.Guard, tmp_path: Path) -> None:
    answer = guard.answer("synth", "render", "tiny", "fem.gestures=[pusch]", "-o", tmp_path / "out")
    refused(answer, "'pusch' is not one of 'pull', 'push'")


OVERRIDES = {
    "appearance.photo=/dev/zero": "no regular file",
    'appearance.photo="a\\0b"': "is no name of a file",
    "appearance.photo=~nobody-here/x": "is no name of a file",
    "appearance.families=&a [*a]": "stands for what it lies in",
    "render.spp=*a": "undefined alias",
    "seed=" + "[" * 5000: "nested deeper",
    ".".join("a" * 1000) + "=1": "section.key=value",
}


@pytest.mark.parametrize("override", OVERRIDES, ids=range(len(OVERRIDES)))
def test_an_override_is_refused(guard: hostile.Guard, tmp_path: Path, override: str) -> None:
    answer = guard.answer("synth", "render", "tiny", override, "-o", tmp_path / "out")
    refused(answer, OVERRIDES[override])


CALIBRATIONS = {
    "deep.yml": "%YAML:1.0\n---\nK: " + "[" * 100_000,
    "deep-list.yml": "%YAML:1.0\n---\nK: " + "- " * 100_000,
    "deep-keys.yml": "%YAML:1.0\n---\n" + "a: " * 100_000,
    "deep.xml": '<?xml version="1.0"?><opencv_storage>' + "<a>" * 100_000,
    "deep.json": "[" * 100_000,
    "huge.yml": "%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 99999\n  cols: 99999\n  dt: d\n  data: [1.]\n",
    "rows.json": '{"K": {"rows": "x", "data": [1]}, "D": [0, 0, 0, 0, 0]}',
    "ragged.json": '{"K": {"rows": 2, "data": [1, 2, 3]}, "D": [0, 0, 0, 0, 0]}',
    "size.json": '{"K": [[9,0,1],[0,9,1],[0,0,1]], "D": [0,0,0,0,0], "width": 0, "height": 0}',
    "shape.json": '{"K": [[9,0,1],[0,9,1],[0,0,1]], "D": [0,0,0,0,0], "width": 100, "height": 100}',
}  # fmt: skip


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_a_calibration_is_refused_before_anything_is_rendered(
    guard: hostile.Guard, tmp_path: Path, name: str
) -> None:
    (tmp_path / name).write_text(CALIBRATIONS[name])
    change = f"render.calibration={tmp_path / name}"
    refused(guard.answer("synth", "render", "tiny", change, "-o", tmp_path / "out"), "render.calibration")
    assert not (tmp_path / "out").exists()


# ---- Recordings.


def png(width: int, height: int) -> bytes:
    """A picture of zeros: a square of 32,000 takes a megabyte."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    squeezed = zlib.compressobj(9)
    row = bytes(1 + (width + 7) // 8)
    data = b"".join(squeezed.compress(row) for _ in range(height)) + squeezed.flush()
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def written(name: str, data: bytes) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)

    return spoil


def pipe(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).parent.mkdir(exist_ok=True)
        os.mkfifo(folder / name)

    return spoil


def link(name: str, to: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(to)

    return spoil


def video(data: bytes | None) -> Spoil:
    def spoil(folder: Path) -> None:
        shutil.rmtree(folder / "frames")
        os.mkfifo(folder / "video.mp4") if data is None else (folder / "video.mp4").write_bytes(data)

    return spoil


def meta(line: str) -> Spoil:
    return lambda folder: (folder / "meta.yaml").write_text(f"scale_mm_per_px: 0.2\n{line}\n") and None


def gigapixels(folder: Path) -> None:
    """A video of a megabyte whose frame, a PNG, is 32,000 pixels square; the container says 32."""
    shutil.rmtree(folder / "frames")
    with av.open(str(folder / "video.mov"), "w") as container:
        stream = container.add_stream("png", rate=1)
        stream.width = stream.height = 32
        stream.pix_fmt = "rgb24"
        packet = av.Packet(png(32_000, 32_000))
        packet.stream, packet.pts, packet.dts, packet.is_keyframe = stream, 0, 0, True
        packet.time_base = Fraction(1)
        container.mux(packet)


PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n/etc/passwd\n#EXT-X-ENDLIST\n"
RECORDINGS: dict[str, tuple[Spoil, str]] = {
    "frame is a pipe": (pipe("frames/0000.png"), "no regular file"),
    "frame is a device": (link("frames/0000.png", "/dev/zero"), "no regular file"),
    "frame of a gigapixel": (written("frames/0000.png", png(32_000, 32_000)), "pixels are too many"),
    "frame of no pixels": (written("frames/0000.png", png(0, 0)), "not a readable picture"),
    "video is a pipe": (video(None), "no regular file"),
    "video is a playlist": (video(PLAYLIST), "not a readable video"),
    "video is a list of files": (video(b"ffconcat version 1.0\nfile /etc/passwd\n"), "not a readable video"),
    "video of a gigapixel": (gigapixels, "not a readable video"),
    "meta is a pipe": (pipe("meta.yaml"), "no regular file"),
    "meta is a bomb": (meta(ALIASES), "stands for more than"),
    "meta is deep": (meta("specimen: " + "[" * 90_000), "nested deeper"),
    "meta has an odd date": (meta("specimen: 2001-99-99"), "not YAML"),
    "meta has a huge number": (meta("rest_frame: 0x" + "f" * 9000), "too large"),
    "meta has a huge decimal": (meta("rest_frame: " + "9" * 9000), "not YAML"),
    "force is a pipe": (pipe("force.csv"), "no regular file"),
    "frame times are a device": (link("frames.csv", "/dev/zero"), "no regular file"),
    "a cell is long": (written("force.csv", b't_s,fx_n,fy_n,fz_n\n"' + b"9" * 200_000), "no line of a table"),
    "tissue is a pipe": (pipe("tissue.png"), "no regular file"),
    "mask is a pipe": (pipe("masks/000000.png"), "no regular file"),
    "header steers a terminal": (written("force.csv", b"\x1b[31mred\n1\n"), r"\x1b[31mred"),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_is_told(guard: hostile.Guard, sound: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(sound, folder)
    spoil, words = RECORDINGS[name]
    spoil(folder)
    refused(guard.answer("bench", "check", folder), words)


@pytest.mark.parametrize("name", ["²", "٣", "9" * 200])
def test_numbers_that_are_none_of_ours_are_passed_over(
    guard: hostile.Guard, sound: Path, tmp_path: Path, name: str
) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(sound, folder)
    (folder / "masks").mkdir()
    for place in ("frames/0000.png", "masks/0.png"):
        shutil.copy(sound / "frames/0000.png", folder / Path(place).with_stem(name))
    answer = guard.answer("bench", "check", folder)
    assert answer.code == 0, answer


def test_one_wrong_time_does_not_take_the_others(guard: hostile.Guard, sound: Path, tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(sound, folder)
    rows = (folder / "force.csv").read_text().splitlines()
    rows[1] = "1e9" + rows[1][rows[1].index(",") :]
    (folder / "force.csv").write_text("\n".join(rows))
    answer = guard.answer("bench", "check", folder)
    assert f"{len(rows) - 2} rows" in answer.out
    assert "1 rows whose time stands still or runs back left out" in answer.out


def test_names_of_files_do_not_steer_a_terminal(guard: hostile.Guard, sound: Path, tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(sound, folder)
    (folder / "frames" / "\x1b[31m.png").write_bytes(b"none")
    answer = guard.answer("bench", "check", folder)
    assert "\\x1b[31m.png: not a readable picture" in answer.out
    assert "\x1b" not in answer.out


def test_paths_may_hold_a_colon(guard: hostile.Guard, tmp_path: Path) -> None:
    folder = Maker(tmp_path)("tcp:rec", frames=3, size=(24, 32), footage="mp4")
    answer = guard.answer("bench", "check", folder.name, cwd=tmp_path)
    assert "3 of 32 x 24 px" in answer.out


def test_a_video_is_written_below_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tcp:out").mkdir()
    monkeypatch.chdir(tmp_path)
    made = preview_video.encode_video(Path("tcp:out/a.mp4"), np.zeros((2, 16, 16, 3), np.uint8), 25.0)
    assert [picture.rgb.shape for picture in read_video(made)] == [(16, 16, 3)] * 2


# ---- Sources to import.


def hdf5(fill: Callable[[h5py.File], object]) -> Spoil:
    def make(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file["frames"] = np.zeros((4, 16, 16, 3), np.uint8)
            file["time"] = np.arange(4) / 10
            fill(file)

    return make


def instead(name: str, **how: object) -> Spoil:
    def fill(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, **how)

    return hdf5(fill)


def damaged(path: Path) -> None:
    hdf5(lambda file: [file.create_group(f"g{k}") for k in range(50)])(path)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"HEAP", b"HELP").replace(b"TREE", b"TREX"))


def mha(*lines: str, data: bytes = bytes(16 * 16 * 2)) -> Spoil:
    usual = ["ObjectType = Image", "NDims = 3", "DimSize = 16 16 2", "ElementType = MET_UCHAR"]
    stamps = [f"Seq_Frame{k:04d}_Timestamp = {k / 10}" for k in range(2)]
    keys = {line.split()[0] for line in lines}
    kept = [line for line in (*usual, *stamps) if line.split()[0] not in keys]
    last = [] if "ElementDataFile" in keys else ["ElementDataFile = LOCAL"]
    return lambda path: path.write_bytes("\n".join([*kept, *lines, *last, ""]).encode() + data) and None


def noise(data: bytes) -> Spoil:
    return lambda path: path.write_bytes(data) and None


def pixels(width: int, height: int) -> Spoil:
    return instead("frames", data=np.zeros((4, height, width, 3), np.uint8))


SOURCES: dict[str, tuple[str, Spoil, str]] = {
    "times in nanoseconds": ("a.h5", instead("time", data=np.arange(4) * 1e8 + 1e9), "look like nanoseconds"),
    "times in milliseconds": ("a.h5", instead("time", data=np.arange(4) * 40.0), "look like milliseconds"),
    "times of an epoch in nanoseconds": ("a.h5", instead("time", data=1.7e18 + np.arange(4)), "in seconds?"),
    "a time that is none": ("a.h5", instead("time", data=[0, 0.1, np.nan, 0.3]), "time of frame 2 is nan"),
    "one pixel": ("a.h5", pixels(1, 1), "1 x 1 pixels"),
    "no pixel": ("a.h5", instead("frames", shape=(4, 0, 0, 3), dtype="u1"), "frames of shape"),
    "gigapixels": (
        "a.h5",
        instead("frames", shape=(4, 32_000, 32_000, 3), dtype="u1", chunks=(1, 10, 10, 3)),
        "too many",
    ),
    "a piece of terabytes": (
        "a.h5",
        instead("frames", shape=(4_000_000, 600, 600, 3), dtype="u1", chunks=(3000, 600, 600, 3)),
        "too large",
    ),
    "ten billion times": ("a.h5", instead("time", shape=(10**10,), dtype="f8", chunks=(1000,)), "too many"),
    "ten billion forces": (
        "a.h5",
        hdf5(lambda f: f.create_dataset("force", shape=(10**10, 3), dtype="f8", chunks=(1000, 3))),
        "too many",
    ),
    "times are texts": ("a.h5", instead("time", data=["a", "b", "c", "d"]), "no row of numbers"),
    "frames are texts": ("a.h5", instead("frames", data=["a", "b", "c", "d"]), "no row of numbers"),
    "time is one number": ("a.h5", instead("time", data=3.0), "no row of numbers"),
    "time lies elsewhere": (
        "a.h5",
        instead("time", shape=(4,), dtype="f8", external=[("/etc/passwd", 0, 32)]),
        "lies in other files",
    ),
    "heaps are damaged": ("a.h5", damaged, "damaged"),
    "cut off": ("a.h5", noise(b"\x89HDF\r\n\x1a\n" + bytes(40)), "HDF5"),
    "pipe": ("a.h5", lambda path: os.mkfifo(path), "no regular file"),
    "pictures lie elsewhere": ("a.mha", mha("ElementDataFile = /etc/passwd"), "lie in another file"),
    "pictures in a list": ("a.mha", mha("ElementDataFile = LIST"), "lie in another file"),
    "head without end": ("a.mha", noise(b"a" * 200_000), "not a readable MetaImage"),
    "sequence of gigapixels": ("a.mha", mha("DimSize = 90000 90000 2"), "too many"),
    "sequence of billions": ("a.mha", mha("DimSize = 16 16 4000000000"), "a.mha"),
    "sequence of one pixel": ("a.mha", mha("DimSize = 1 1 2"), "1 x 1 pixels"),
    "bag of noise": ("a.mcap", noise(b"\x89MCAP0\r\n" + bytes(500)), "a.mcap"),
    "database of noise": ("a.db3", noise(b"SQLite format 3\0" + bytes(90)), "a.db3"),
    "old bag of noise": ("a.bag", noise(b"#ROSBAG V2.0\n" + bytes(90)), "a.bag"),
}  # fmt: skip


@pytest.mark.parametrize("name", SOURCES)
def test_a_source_is_refused(guard: hostile.Guard, tmp_path: Path, name: str) -> None:
    file, make, words = SOURCES[name]
    make(tmp_path / file)
    answer = guard.answer("bench", "import", tmp_path / file, "-o", tmp_path / "rec", "--scale", "0.1")
    refused(answer, words)
    assert sorted(path.name for path in tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("about", "words"),
    [
        (ALIASES, "stands for more than"),
        ("rosbag2_bagfile_information: {relative_file_paths: [../secret.db3]}", "not in its folder"),
        ("rosbag2_bagfile_information: 3", "doesn't say"),
    ],
)
def test_a_bags_own_words_are_checked(guard: hostile.Guard, tmp_path: Path, about: str, words: str) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/metadata.yaml").write_text(about)
    refused(guard.answer("bench", "import", tmp_path / "bag", "-o", tmp_path / "rec"), words)


# ---- What is written.


def test_an_output_that_is_a_file_is_found_before_the_work(
    guard: hostile.Guard, sound: Path, tmp_path: Path
) -> None:
    (tmp_path / "wall").write_text("mine")
    for out in (tmp_path / "wall", tmp_path / "wall/within"):
        # The model isn't there: were it opened first, that would be said.
        answer = guard.answer("bench", "score", sound, "--model", tmp_path / "none", "-o", out)
        refused(answer, "a file is in the way")
    assert (tmp_path / "wall").read_text() == "mine"
    answer = guard.answer("bench", "score", sound, "--model", tmp_path / "none", "-o", tmp_path / "new/out")
    refused(answer, "none")
    assert [path.name for path in tmp_path.iterdir()] == ["wall"]


def test_a_link_in_a_foreign_dataset_is_not_written_through(guard: hostile.Guard, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "out/.run").symlink_to(tmp_path / "mine")
    refused(guard.answer("synth", "render", "tiny", "-o", tmp_path / "out"), "is a link")
    assert not list((tmp_path / "mine").iterdir())
