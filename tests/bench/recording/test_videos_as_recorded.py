"""Videos as recorders, editors and copies leave them: the right pictures and clock, or a word on what is
wrong."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from fake_recording import Maker, texture

from bench.checks.check_recording import check_recording
from bench.importers import importer_registry
from bench.recording import recording_writer
from bench.recording.recording_folder import open_recording
from synth.errors import UserError
from synth.video import read_video as video
from synth.video.file_numbers import find_stamps, number_files, still_times
from synth.video.read_video import VideoFile

FPS = 25
SHIFTED_FRAMES = [np.roll(texture(96, 128, 1), 2 * k, axis=1) for k in range(20)]
OTHER = [texture(96, 128, 9)] * 20


def mux(
    path: Path, films: Sequence[list[np.ndarray]], *, cover: bool = False, sound_s: float | None = None
) -> Path:
    """Films from 0.5 s on if there is sound, which begins at `sound_s`; a cover comes first."""
    with av.open(str(path), "w") as out:
        packets: list[av.Packet] = []
        for pictures in ([[OTHER[0]]] if cover else []) + list(films):
            is_cover = len(pictures) == 1
            stream = out.add_stream("mjpeg" if is_cover else "libx264", rate=1 if is_cover else FPS)
            stream.height, stream.width = pictures[0].shape[:2]
            stream.pix_fmt = "yuvj420p" if is_cover else "yuv420p"
            stream.options = {} if is_cover else {"crf": "8", "bf": "0"}
            for k, rgb in enumerate(pictures):
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
                frame.pts, frame.time_base = (
                    round((k / FPS + 0.5 * (sound_s is not None)) * 90000),
                    Fraction(1, 90000),
                )
                stream.codec_context.time_base = Fraction(1, 90000)
                packets += stream.encode(frame)
            packets += stream.encode(None)
        if sound_s is not None:
            sound = out.add_stream("aac", rate=48000)
            for k in range(40):
                frame = av.AudioFrame.from_ndarray(
                    np.zeros((1, 1024), np.float32), format="fltp", layout="mono"
                )
                frame.sample_rate, frame.pts = 48000, k * 1024 + int(sound_s * 48000)
                frame.time_base = Fraction(1, 48000)
                packets += sound.encode(frame)
            packets += sound.encode(None)
        for packet in sorted(packets, key=lambda packet: float((packet.dts or 0) * packet.time_base)):
            out.mux(packet)
    return path


def find_nearest(pictures: Sequence[np.ndarray]) -> list[int]:
    return [
        int(np.argmin([np.abs(picture.astype(int) - rgb).mean() for rgb in SHIFTED_FRAMES]))
        for picture in pictures
    ]


@pytest.mark.parametrize("name", ["v.mp4", "v.mkv", "v.ts"])
def test_sound_that_begins_first_does_not_move_the_clock(name: str, make: Maker, tmp_path: Path) -> None:
    source = mux(tmp_path / name, [SHIFTED_FRAMES], sound_s=0.0)
    assert [picture.time_s for picture in video.read_video(source)] == pytest.approx(
        np.arange(20) / FPS, abs=1e-3
    )
    from_file = [picture.time_s for picture in video.read_video(VideoFile(source, from_file=True))]
    assert from_file == pytest.approx(0.5 + np.arange(20) / FPS, abs=0.03)  # the codec's priming is sound too
    folder = make("one", frames=2, footage="mp4")
    (folder / "video.mp4").unlink()
    source.rename(folder / f"video{source.suffix}")
    assert any("after the start" in note for note in open_recording(folder).notes)
    with (folder / "meta.yaml").open("a") as file:
        file.write("start: file\n")
    assert next(iter(open_recording(folder).frames())).time_s == pytest.approx(0.5, abs=0.03)


def test_covers_are_skipped_and_films_are_chosen(tmp_path: Path) -> None:
    video_with_cover = mux(tmp_path / "c.mkv", [SHIFTED_FRAMES], cover=True)
    assert find_nearest([picture.rgb for picture in video.read_video(video_with_cover)]) == [*range(20)]
    two_films = mux(tmp_path / "s.mkv", [OTHER, SHIFTED_FRAMES])
    with pytest.raises(UserError, match="2 films"):
        next(video.read_video(two_films))
    intake = importer_registry.read_source(two_films, {"stream": "1"})
    assert find_nearest(list(intake.pictures())) == [*range(20)]
    with pytest.raises(UserError):
        importer_registry.read_source(two_films, {"stream": "2"})


@pytest.mark.parametrize("codec", ["libx264", "mpeg2video"])
def test_pictures_after_lost_packets_are_lost_until_the_next_whole_one(
    codec: str, make: Maker, tmp_path: Path
) -> None:
    with av.open(str(tmp_path / "v.ts"), "w") as out:
        stream = out.add_stream(codec, rate=FPS)
        stream.height, stream.width, stream.pix_fmt = 96, 128, "yuv420p"
        stream.options = {"g": "40", "bf": "0", "crf": "8", "b": "4000000"}
        for rgb in 3 * SHIFTED_FRAMES:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")))
        out.mux(stream.encode(None))
    data = (tmp_path / "v.ts").read_bytes()
    packets, rng = [data[k : k + 188] for k in range(0, len(data), 188)], np.random.default_rng(1)
    count = len(packets)
    remaining_packets = [
        p for k, p in enumerate(packets) if not 0.2 * count < k < 0.3 * count or rng.random() > 0.3
    ]
    folder = make(frames=2, footage="mp4")
    (folder / "video.mp4").unlink()
    (folder / "video.ts").write_bytes(b"".join(remaining_packets))
    pictures = list(video.read_video(folder / "video.ts"))
    errors = np.array(
        [
            np.abs(SHIFTED_FRAMES[round((picture.time_s or 0) * FPS) % 20].astype(int) - picture.rgb).mean()
            for picture in pictures
        ]
    )
    damaged = np.array([picture.damaged for picture in pictures])
    timed = np.array([picture.time_s is not None for picture in pictures])
    assert 0 < damaged.sum() < len(pictures)
    assert not damaged[0]
    assert errors[~damaged & timed].max() < 8, "a picture that isn't marked is as it was taken"
    assert any(
        finding.severity == "warning" and "damaged" in finding.message for finding in check_recording(folder)
    )


def test_a_video_that_ends_early_is_named(make: Maker, tmp_path: Path) -> None:
    with av.open(str(tmp_path / "v.mp4"), "w", options={"movflags": "faststart"}) as out:
        stream = out.add_stream("libx264", rate=FPS, options={"crf": "8", "g": "10"})
        stream.height, stream.width, stream.pix_fmt = 96, 128, "yuv420p"
        for rgb in 4 * SHIFTED_FRAMES:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")))
        out.mux(stream.encode(None))
    data = (tmp_path / "v.mp4").read_bytes()
    folder = make(frames=2, footage="mp4")
    for share, is_named in ((1.0, False), (0.6, True)):
        (folder / "video.mp4").write_bytes(data[: int(share * len(data))])
        findings = [finding for finding in check_recording(folder) if "pictures end at" in finding.message]
        assert bool(findings) == is_named


@pytest.mark.parametrize(
    "content",
    [
        b"",
        bytes(4000),
        b"version https://git-lfs.github.com/spec/v1\noid sha256:01\n",
        b"<!DOCTYPE html><html>",
        None,
    ],
)
def test_what_is_no_video_is_refused(content: bytes | None, tmp_path: Path) -> None:
    recording_writer.write_video(tmp_path / "v.mp4", iter(SHIFTED_FRAMES), np.arange(20) / FPS)
    data = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "v.mp4").write_bytes(data[: len(data) // 2] if content is None else content)
    with pytest.raises(UserError) as caught:
        next(video.read_video(tmp_path / "v.mp4"))
    assert "Invalid data" not in str(caught.value)


def test_chapters_are_joined_with_their_gaps(tmp_path: Path) -> None:
    def chapter(name: str, pictures: list[np.ndarray], date: str = "") -> None:
        with av.open(str(tmp_path / name), "w") as out:
            if date:
                out.metadata["creation_time"] = date
            stream = out.add_stream("libx264", rate=FPS, options={"crf": "8"})
            stream.height, stream.width, stream.pix_fmt = 96, 128, "yuv420p"
            for rgb in pictures:
                out.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")))
            out.mux(stream.encode(None))

    chapter("GX010123.MP4", SHIFTED_FRAMES[:10])
    chapter("GX020123.MP4", SHIFTED_FRAMES[10:])
    intake = importer_registry.read_source(tmp_path)
    assert intake.times_s == pytest.approx(np.arange(20) / FPS, abs=1e-4)
    assert find_nearest(list(intake.pictures())) == [*range(20)]
    chapter("GX010123.MP4", SHIFTED_FRAMES[:10], "2026-11-28T10:00:00Z")
    chapter("GX020123.MP4", SHIFTED_FRAMES[10:], "2026-11-28T10:00:30Z")
    assert importer_registry.read_source(tmp_path).times_s[10] == pytest.approx(30)
    chapter("GX010124.MP4", SHIFTED_FRAMES[:10])  # another recording
    with pytest.raises(UserError, match="GX010124"):
        importer_registry.read_source(tmp_path)
    assert len(importer_registry.read_source(tmp_path, {"frames": "GX0?0123.MP4"}).times_s) == 20


def test_folders_as_people_keep_them(make: Maker) -> None:
    folder = make(frames=4, meta={"fps": 10.0})
    (folder / "frames.csv").unlink()
    expected = [0, 0.1, 0.2, 0.3]
    stills = sorted((folder / "frames").iterdir())
    for k, path in enumerate(stills):
        path.rename(folder / f"frames/{100 * k + 1:06d}.png")  # milliseconds
    assert [frame.time_s for frame in open_recording(folder).frames()] == pytest.approx(expected)
    for k, path in enumerate(sorted((folder / "frames").iterdir())):
        cv2.imwrite(str(folder / f"frames/{k:03d}.JPG"), cv2.imread(str(path)))
        path.unlink()
    assert [frame.time_s for frame in open_recording(folder).frames()] == pytest.approx(expected)
    (folder / "masks").mkdir()
    for k in range(4):
        mask = np.full((96, 128), 255, np.uint8)
        mask[:20, :30] = 0
        cv2.imwrite(str(folder / f"masks/{k:03d}.png"), mask)
    assert any(
        finding.cause == "tool" and finding.severity == "warning" for finding in check_recording(folder)
    )


@pytest.mark.parametrize("name", ["Video.MP4", "left.mp4", "GX010123.MP4"])
def test_the_only_video_of_a_folder_is_its_video(name: str, make: Maker) -> None:
    folder = make(frames=4, footage="mp4")
    (folder / "video.mp4").rename(folder / name)
    assert len(list(open_recording(folder).frames())) == 4
    (folder / name).with_name("other.mov").write_bytes((folder / name).read_bytes())
    if name != "Video.MP4":
        with pytest.raises(UserError, match=r"other\.mov"):
            open_recording(folder)


def test_numbers_in_names_are_frames_or_times(tmp_path: Path) -> None:
    def times(numbers: Sequence[int], fps: float) -> list[float]:
        files = number_files([tmp_path / f"a{number:d}.png" for number in numbers])
        return [*still_times(files, fps, []).values()]

    assert times(range(5), 25) == pytest.approx(np.arange(5) / 25)
    assert times([0, 40, 80, 120], 25) == pytest.approx([0, 0.04, 0.08, 0.12])
    assert times([7, 40, 73, 107, 140], 30) == pytest.approx([0, 0.033, 0.066, 0.1, 0.133])
    assert times([0, 5, 10, 15], 25) == pytest.approx([0, 0.2, 0.4, 0.6])  # every fifth frame
    assert times([3, 4, 6], 10) == pytest.approx([0, 0.1, 0.3])
    stamps = [tmp_path / f"{1_700_000_000_000_000_000 + 40_000_000 * k}.png" for k in range(3)]
    assert find_stamps(stamps) == pytest.approx(1.7e9 + 0.04 * np.arange(3), abs=1e-6, rel=0)
    assert find_stamps([tmp_path / "000001.png"]) is None
