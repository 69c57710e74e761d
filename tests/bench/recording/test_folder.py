"""Reading recordings: times, gaps, rotation, pixel aspect and numbers."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from fake_recording import Maker, texture
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.recording import meta, recording_writer
from bench.recording.recording_folder import Recording, open_recording
from synth.errors import UserError
from synth.system import csv_table
from synth.video import read_video as video


def test_variable_frame_rate_keeps_its_times(tmp_path: Path) -> None:
    times = np.array([0, 0.04, 0.08, 0.21, 0.233, 1.0])
    recording_writer.write_video(tmp_path / "v.mp4", iter([texture(32, 48, k) for k in range(6)]), times)
    read_times = [picture.time_s for picture in video.read_video(tmp_path / "v.mp4")]
    assert read_times == pytest.approx(times, abs=1e-4)


def test_times_of_day_keep_their_microseconds(tmp_path: Path) -> None:
    """Seconds since 1970, as a ROS bag stamps them, need sixteen figures."""
    times = 1.7e9 + np.array([0.0, 0.04, 0.080001])
    recording_writer.write_frames(tmp_path, times)
    recording_writer.write_force(tmp_path, times, np.eye(3))
    for name in ("frames", "force"):
        table = csv_table.read_csv(tmp_path / f"{name}.csv", ("t_s",) + ("fy_n",) * (name == "force"))
        assert table["t_s"] == pytest.approx(times, abs=1e-6, rel=0)
    assert table["fy_n"].tolist() == [0, 1, 0]


def test_force_in_mn_sign_and_gaps(make: Maker) -> None:
    folder = make(frames=3, meta={"sensor": {"acts_on": "tool"}})
    (folder / "force.csv").write_text(
        "t_s,fx_n,fy_n,fz_n,extra\n0,0.1,0,0,x\n0.1,,0,0,x\n0.2,0.3,0,0,x\n0.2,9,9,9,x\n"
    )
    recording = open_recording(folder)
    assert recording.force.force_mn[[0, 2], 0].tolist() == [-100.0, -300.0]
    assert np.isnan(recording.force.force_mn[1]).all()
    assert len(recording.force.time_s) == 3
    assert len(recording.notes) == 2


def test_quoted_cells_and_unambiguous_decimal_commas_are_read(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    for text, expected in (
        ('note,t_s,fx_n\n"a, then b",1,2\nc,3,4\n"say ""x"", y",5,"6"\n', [[1, 3, 5], [2, 4, 6]]),
        ("t_s;fx_n\n0,5;-1,25\n", [[0.5], [-1.25]]),
    ):
        file.write_text(text)
        assert [column.tolist() for column in csv_table.read_csv(file, ("t_s", "fx_n")).values()] == expected
    file.write_text("t_s,fx_n\n0,5,-1,25\n")
    with pytest.raises(UserError, match=r"t\.csv:2"):
        csv_table.read_csv(file, ("t_s", "fx_n"))


@pytest.mark.parametrize("footage", ["png", "mp4"])
def test_frames_that_the_table_lacks_have_no_time(make: Maker, footage: str) -> None:
    folder = make(frames=4, footage=footage, meta={"fps": 10.0})
    (folder / "frames.csv").write_text("frame,t_s\n0,100\n2,100.4\n")
    assert [frame.time_s for frame in open_recording(folder).frames()] == [100, None, 100.4, None]
    (folder / "frames.csv").unlink()
    if footage == "png":
        times = [frame.time_s for frame in open_recording(folder).frames()]
        assert times == pytest.approx([0, 0.1, 0.2, 0.3])


def _write_numbered(folder: Path, count: int, first: int, lost: int) -> Recording:
    """Pictures of which all but one are there, counted from `first`; masks and times of all, from 0."""
    for name in ("frames", "masks"):
        (folder / name).mkdir()
    for k in range(count):
        assert cv2.imwrite(str(folder / f"masks/{k:06d}.png"), 255 * (np.arange(24).reshape(4, 6) <= k))
        if k != lost:
            assert cv2.imwrite(str(folder / f"frames/f2_{k + first}.png"), np.full((4, 6), k, np.uint8))
    recording_writer.write_frames(folder, 0.5 * np.arange(count))
    recording_writer.write_meta(folder, {"scale_mm_per_px": 0.1, "young_kpa": 1.0})
    return open_recording(folder)


@given(count=st.integers(3, 14), first=st.integers(0, 1), lost=st.integers(0, 14))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_files_of_one_moment_have_the_same_number(
    tmp_path_factory: pytest.TempPathFactory, count: int, first: int, lost: int
) -> None:
    """A lost picture is a gap; counting from 1 is detected, or refused where a loss makes it ambiguous."""
    folder = tmp_path_factory.mktemp("numbered")
    if lost < count and (first or lost == 0):
        with pytest.raises(UserError, match=r"frames\.csv"):
            _write_numbered(folder, count, first, lost)
        return
    recording = _write_numbered(folder, count, first, lost)
    pictures = list(recording.frames())
    assert len(pictures) == count - (lost < count)
    for picture in pictures:
        moment = int(picture.rgb[0, 0, 0])
        assert picture.time_s == 0.5 * moment
        mask = recording.masks.read(picture.index, (4, 6))
        assert mask.sum() == min(moment + 1, 24)


def test_pixels_of_a_video_are_made_square(tmp_path: Path) -> None:
    """A disc recorded with 4:3 pixels is round."""
    x, y = np.meshgrid(np.arange(96), np.arange(96))
    disc = (((x - 47.5) * 4 / 3) ** 2 + (y - 47.5) ** 2 < 30**2).astype(np.uint8)
    with av.open(str(tmp_path / "v.mp4"), "w") as out:
        stream = out.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 96, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        frame = av.VideoFrame.from_ndarray(np.dstack([255 * disc] * 3), format="rgb24")
        for packet in [*stream.encode(frame), *stream.encode()]:
            out.mux(packet)
    (picture,) = video.read_video(tmp_path / "v.mp4")
    disc_found = picture.rgb[..., 0] > 127
    assert disc_found.shape == (96, 128)
    assert disc_found.any(0).sum() == pytest.approx(disc_found.any(1).sum(), abs=3)


def test_frames_are_counted_if_the_container_does_not_state_their_number(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=9, footage="mp4")
    with av.open(str(folder / "video.mp4")) as source, av.open(str(folder / "video.mkv"), "w") as copy:
        stream = copy.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = stream
                copy.mux(packet)
    (folder / "video.mp4").unlink()
    assert list(open_recording(folder).numbers) == list(range(9))


def test_a_written_meta_is_read_back_as_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "meta.yaml").write_text(meta.document_meta())
    assert meta.read_meta(tmp_path / "meta.yaml") == meta.Meta(scale_mm_per_px="unknown")


@pytest.mark.parametrize("name", ["/etc/hosts", "../pair.yaml", "link.yaml"])
def test_a_calibration_stays_in_the_recordings_folder(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "recording"
    inside.mkdir()
    (tmp_path / "pair.yaml").touch()
    (inside / "link.yaml").symlink_to("../pair.yaml")
    for section in ("stereo:\n  calibration", "calibration: {corners: [3, 3], square_mm: 1, checkerboard"):
        end = "}" if "{" in section else ""
        (inside / "meta.yaml").write_text(f"{section}: {name}{end}\n")
        with pytest.raises(UserError, match=name):
            meta.read_meta(inside / "meta.yaml")
