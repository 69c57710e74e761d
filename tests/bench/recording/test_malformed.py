"""Broken recordings: each gives a one-line error or finding; none crashes."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_recording import Maker, score_recording, texture

from bench.checks.check_recording import check_recording
from bench.recording import recording_writer
from synth.errors import UserError
from synth.system import checked_file

Corruption = Callable[[Path], object]


def text(name: str, content: str) -> Corruption:
    return lambda folder: (folder / name).write_text(content) and None


def rows(change: Callable[[list[str]], list[str]]) -> Corruption:
    def corrupt(folder: Path) -> None:
        lines = (folder / "force.csv").read_text().splitlines()
        (folder / "force.csv").write_text("\n".join([lines[0], *change(lines[1:])]) + "\n")

    return corrupt


def cut_video(folder: Path) -> None:
    shutil.rmtree(folder / "frames")
    (folder / "frames.csv").unlink()
    recording_writer.write_video(folder / "video.mp4", iter([texture(96, 128)] * 6), np.arange(6) / 10)
    data = (folder / "video.mp4").read_bytes()
    (folder / "video.mp4").write_bytes(data[: len(data) // 2])


HEAD = "t_s,fx_n,fy_n,fz_n\n"
CASES: dict[str, Corruption] = {
    "no meta": lambda folder: (folder / "meta.yaml").unlink(),
    "meta is not yaml": text("meta.yaml", "a: [1\nb: 2"),
    "pictures of two sizes": lambda folder: cv2.imwrite(str(folder / "frames/0003.png"), texture(50, 128)),
    "video cut off": cut_video,
    "frame times run back": text("frames.csv", "frame,t_s\n0,0\n1,5\n2,3\n3,4\n4,6\n"),
    "force column missing": text("force.csv", "t_s,fx_n\n0,0\n"),
    "force all nan": text("force.csv", HEAD + "0,nan,nan,nan\n1,nan,nan,nan\n"),
    "an axis is empty": text("force.csv", HEAD + "0,1,,2\n0.1,1,,2\n0.2,1,,2\n"),
    "force in millinewtons": rows(lambda lines: [f"{k / 100},{k * 90},0,0" for k in range(90)]),
    "sensor clock in ms": rows(lambda lines: [f"{k * 10},0.1,0,0" for k in range(90)]),
    "sensor clock elsewhere": rows(lambda lines: [f"{1e9 + k},0.1,0,0" for k in range(90)]),
}


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Maker(tmp_path_factory.mktemp("intact"))(frames=8)


def test_an_intact_recording_has_no_problems(intact: Path, tmp_path: Path) -> None:
    picture_path = tmp_path / "tracked.png"
    severities = {finding.severity for finding in check_recording(intact, picture=picture_path)}
    assert severities <= {"ok", "missing"}
    rows, columns = np.array(cv2.imread(str(picture_path)).shape[:2]) // (4 * 96, 4 * 128)
    assert (rows, columns) == (2, 3)  # five frames and a legend, enlarged fourfold


NUMBERS = [
    {"scale_mm_per_px": 1e150}, {"scale_mm_per_px": 1e-150}, {"young_kpa": 1e300}, {"fps": 1e-300},
    {"sync": {"method": "offset", "offset_s": 1e200}}, {"sync": {"rate": 1e9}}, {"rest_frame": 10**30},
    {"sensor": {"mass_g": 1e200}}, {"sensor": {"free_s": [[0, 1e200]]}}, {"press_s": [-1e200, 1]},
    {"scale_mm_per_px": None, "calibration": {"focal_px": 1e200, "distance_mm": 1}},
    {"scale_mm_per_px": None, "calibration": {"bar_px": [[0, 0], [1e200, 0]], "bar_mm": 1}},
]  # fmt: skip


@pytest.mark.parametrize("changes", NUMBERS)
def test_numbers_beyond_all_recordings_are_refused(
    intact: Path, tmp_path: Path, changes: dict[str, object]
) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(intact, folder)
    about = checked_file.read_yaml(folder / "meta.yaml") | changes
    recording_writer.write_meta(folder, {key: value for key, value in about.items() if value is not None})
    (problem,) = (finding for finding in check_recording(folder) if finding.severity == "error")
    assert "\n" not in problem.message


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_largest_and_least_numbers_are_reported(intact: Path, tmp_path: Path, scale: float) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(intact, folder)
    about = checked_file.read_yaml(folder / "meta.yaml") | {"scale_mm_per_px": scale, "young_kpa": scale}
    recording_writer.write_meta(folder, about)
    assert {finding.cause for finding in check_recording(folder) if finding.severity == "error"} == {
        "scale",
        "stiffness",
    }


@pytest.mark.parametrize("name", CASES)
def test_a_broken_recording_is_reported(intact: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(intact, folder)
    CASES[name](folder)
    findings = check_recording(folder)
    assert any(finding.severity in ("warning", "error") for finding in findings)
    assert "scale" not in {finding.cause for finding in findings if finding.severity == "error"}
    try:
        notes: tuple[str, ...] = score_recording(folder, backend="dis").notes
    except UserError as error:
        notes = (str(error),)
    assert not any("\n" in line for line in (*notes, *(finding.message for finding in findings)))
