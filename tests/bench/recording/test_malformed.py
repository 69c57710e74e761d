"""Broken recordings: each gives a clear line or a stated partial result; none crashes or hangs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_recording import Bump, Maker, texture

from bench.recording import check, pixel_scale, writer
from bench.recording.folder import open_recording
from bench.scoring import evaluate_recording
from synth.errors import UserError

Spoil = Callable[[Path], None]


def text(name: str, content: str) -> Spoil:
    return lambda folder: (folder / name).write_text(content) and None


def data(name: str, content: bytes) -> Spoil:
    return lambda folder: (folder / name).write_bytes(content) and None


def meta(extra: str, drop: str = "") -> Spoil:
    def spoil(folder: Path) -> None:
        lines = (folder / "meta.yaml").read_text().splitlines()
        kept = [line for line in lines if not (drop and line.startswith(drop))]
        (folder / "meta.yaml").write_text("\n".join([*kept, extra]) + "\n")

    return spoil


def rows(change: Callable[[list[str]], list[str]]) -> Spoil:
    def spoil(folder: Path) -> None:
        lines = (folder / "force.csv").read_text().splitlines()
        (folder / "force.csv").write_text("\n".join([lines[0], *change(lines[1:])]) + "\n")

    return spoil


def gone(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return spoil


def picture(name: str, array: np.ndarray) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), array)

    return spoil


def cut_video(folder: Path) -> None:
    shutil.rmtree(folder / "frames")
    (folder / "frames.csv").unlink()
    writer.write_video(folder / "video.mp4", iter([texture(96, 128)] * 6), np.arange(6) / 10)
    whole = (folder / "video.mp4").read_bytes()
    (folder / "video.mp4").write_bytes(whole[: len(whole) // 2])


def both(folder: Path) -> None:
    writer.write_video(folder / "video.mp4", iter([texture(96, 128)] * 2), np.arange(2) / 10)


def no_video(content: bytes) -> Spoil:
    def spoil(folder: Path) -> None:
        shutil.rmtree(folder / "frames")
        (folder / "video.mp4").write_bytes(content)

    return spoil


HEAD = "t_s,fx_n,fy_n,fz_n\n"
NOTHING = np.zeros((96, 128), np.uint8)
CASES: dict[str, tuple[Spoil, str]] = {
    "no meta": (gone("meta.yaml"), "missing"),
    "empty meta": (text("meta.yaml", ""), "expected keys"),
    "meta is a list": (text("meta.yaml", "- 1\n- 2\n"), "expected keys"),
    "meta is not yaml": (text("meta.yaml", "a: [1\nb: 2"), "not YAML"),
    "meta is binary": (data("meta.yaml", bytes(range(128, 256))), "unreadable"),
    "unknown key": (meta("colour: red"), "colour"),
    "no scale": (meta("", drop="scale_mm_per_px"), "either scale_mm_per_px or calibration"),
    "scale twice": (meta("calibration: {focal_px: 1000, distance_mm: 300}"), "either scale_mm_per_px"),
    "negative scale": (meta("scale_mm_per_px: -0.1", drop="scale"), "greater than 0"),
    "scale is nan": (meta("scale_mm_per_px: .nan", drop="scale"), "finite"),
    "scale is text": (meta("scale_mm_per_px: wide", drop="scale"), "valid number"),
    "half a calibration": (meta("calibration: {bar_mm: 5}", drop="scale"), "one whole way"),
    "no checkerboard": (
        meta("calibration: {checkerboard: none.png, corners: [7, 5], square_mm: 2}", drop="scale"),
        "no such file",
    ),
    "zero stiffness": (meta("young_kpa: 0", drop="young"), "greater than 0"),
    "stiffness in pascal": (meta("young_kpa: 1200", drop="young"), "is it in kPa"),
    "scale in micrometres": (meta("scale_mm_per_px: 200", drop="scale"), "is the scale in mm/px"),
    "rest frame beyond the end": (meta("rest_frame: 99"), "rest_frame"),
    "sync without a span": (meta("sync: {method: correlate}"), "calibration_s"),
    "sync on too short a span": (
        meta("sync: {method: correlate, calibration_s: [0, 0.3]}"),
        "could not be aligned",
    ),
    "press backwards": (meta("press_s: [0.5, 0.2]"), "press_s: a span must end after its beginning"),
    "no pictures": (gone("frames"), "neither video"),
    "video and pictures": (both, "keep one"),
    "picture is broken": (data("frames/0003.png", b"png?"), "not a readable picture"),
    "pictures of two sizes": (picture("frames/0003.png", NOTHING[:50]), "the frames before it"),
    "empty video": (no_video(b""), "not a readable video"),
    "video is text": (no_video(b"hello" * 100), "not a readable video"),
    "video cut off": (cut_video, "not a readable video"),
    "mask of another size": (picture("masks/000002.png", NOTHING[:10]), "the video is"),
    "no tissue marked": (picture("tissue.png", NOTHING), "marks n"),
    "frame times missing": (gone("frames.csv"), "no frame has a time"),
    "frame times run back": (text("frames.csv", "frame,t_s\n0,0\n1,5\n2,3\n3,4\n4,6\n"), "runs back"),
    "frame listed twice": (text("frames.csv", "frame,t_s\n0,0\n0,1\n"), "listed twice"),
    "frame numbers absurd": (text("frames.csv", "frame,t_s\n0,0\n99999999,1\n"), "lists frame"),
    "force column missing": (text("force.csv", "t_s,fx_n\n0,0\n"), "missing column"),
    "force file empty": (text("force.csv", ""), "missing column"),
    "force header only": (text("force.csv", HEAD), "no rows"),
    "force all nan": (text("force.csv", HEAD + "0,nan,nan,nan\n1,nan,nan,nan\n"), "fewer than two rows"),
    "force has words": (text("force.csv", HEAD + "0,0,0,0\n1,a,0,0\n"), "'a' is not a number"),
    "force row cut off": (rows(lambda lines: [*lines[:-1], lines[-1][:6]]), "cut off"),
    "force in millinewtons": (rows(lambda lines: [f"{k / 100},{k * 90},0,0" for k in range(90)]), "in mN"),
    "sensor clock in ms": (
        rows(lambda lines: [f"{k * 10},0.1,0,0" for k in range(90)]),
        "look like milliseconds, not seconds: predictions only",
    ),
    "fast sensor's clock in ms": (
        rows(lambda lines: [f"{k},0.1,0,0" for k in range(900)]),
        "look like milliseconds, not seconds: predictions only",
    ),
    "sensor clock elsewhere": (
        rows(lambda lines: [f"{1e9 + k},0.1,0,0" for k in range(90)]),
        "share no time",
    ),
    "sensor clock jumps back": (rows(lambda lines: lines[50:] + lines[:50]), "runs back left out"),
    "sensor has holes": (rows(lambda lines: lines[:20] + lines[80:]), "covers"),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Maker(tmp_path_factory.mktemp("sound"))(frames=8)


def said(folder: Path) -> str:
    """What scoring says: its error, or the notes of its partial result."""
    try:
        recording = open_recording(folder)
        found = pixel_scale.find_scale(recording.meta, folder)
        settings = evaluate_recording.Settings(backend="dis")
        result = evaluate_recording.evaluate_recording(
            recording, {"bump": Bump()}, "bump", found, settings, {}
        )
    except UserError as error:
        return str(error)
    assert len(result.time_s) > 0
    return " ".join(result.notes)


def test_the_sound_one_has_nothing_bad(sound: Path) -> None:
    states = {finding.state for finding in check.check_recording(sound)}
    assert states <= {"ok", "lack"}


def test_every_part_of_a_recording_is_broken_once() -> None:
    parts = {"meta", "scale", "stiffness", "sync", "picture", "video", "mask", "frame", "force", "sensor"}
    assert parts <= {name.split()[0] for name in CASES}


@pytest.mark.parametrize("name", CASES)
def test_broken_recording_is_told(sound: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(sound, folder)
    spoil, words = CASES[name]
    spoil(folder)
    findings = check.check_recording(folder)
    heard = said(folder) + " " + " ".join(f"{f.what}: {f.said}" for f in findings)
    assert words in heard, heard
    assert "\n" not in heard
    assert any(finding.state != "ok" for finding in findings)
