"""Writers of the files of a recording folder, which `bench.recording.recording_folder` reads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import av
import cv2
import numpy as np
from ruamel.yaml import YAML

from synth.arrays import Array, Floats, Pixels
from synth.video.write_video import encode

if TYPE_CHECKING:
    from synth.render.camera.camera import Camera


def write_frames(folder: Path, time_s: Floats) -> None:
    """Writes frames.csv: the time of every frame, (T,) s."""
    _csv(folder / "frames.csv", "frame,t_s", "%d,%.6f", np.column_stack([np.arange(len(time_s)), time_s]))


def write_force(folder: Path, time_s: Floats, newtons: Floats, axes: str = "xyz") -> None:
    """Writes force.csv: the sensor's times (N,) s and forces (N, 3) N; of some `axes`, or empty: the size."""
    chosen = [newtons[:, "xyz".index(axis)] for axis in axes] or [newtons[:, 0]]
    head = ",".join(["t_s", *(f"f{axis}_n" for axis in axes or ("",))])
    _csv(folder / "force.csv", head, "%.6f" + len(chosen) * ",%.9f", np.column_stack([time_s, *chosen]))


def write_poses(folder: Path, time_s: Floats, poses: Mapping[str, Floats]) -> None:
    """Writes poses.csv: for each instrument by name the place and the rotation's rows of its pose (T, 4,
    4)."""
    parts = [
        f"{name}_{part}"
        for name in poses
        for part in ("x", "y", "z", *(f"r{i}{j}" for i in "123" for j in "123"))
    ]
    rows = [np.column_stack([pose[:, :3, 3], pose[:, :3, :3].reshape(-1, 9)]) for pose in poses.values()]
    columns = np.column_stack([np.arange(len(time_s)), time_s, *rows])
    _csv(folder / "poses.csv", ",".join(["frame", "t_s", *parts]), "%d,%.6f" + len(parts) * ",%.9g", columns)


def write_meta(folder: Path, keys: Mapping[str, object]) -> None:
    """Writes meta.yaml."""
    with (folder / "meta.yaml").open("w", encoding="utf-8") as file:
        YAML().dump(dict(keys), file)


def write_pair(path: Path, left: Camera, right: Camera) -> None:
    """Writes a stereo calibration, K1, D1, K2, D2, R, T, as OpenCV's `stereoCalibrate` returns it."""
    turn = right.rotation @ left.rotation.T
    lenses = {"K1": left.K, "D1": left.distortion, "K2": right.K, "D2": right.distortion}
    write_storage(path, {**lenses, "R": turn, "T": (right.translation - turn @ left.translation)[:, None]})


def write_storage(path: Path, matrices: Mapping[str, Floats]) -> None:
    """Writes matrices, (N, M) or (M,), as an OpenCV FileStorage."""
    storage = cv2.FileStorage(path.name, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, values in matrices.items():
        storage.write(name, np.atleast_2d(values))
    path.write_text(storage.releaseAndGetString(), "utf-8")  # OpenCV takes no path that is not UTF-8


def write_second(folder: Path, frames: Iterable[int], pictures: Iterable[Array]) -> None:
    """Writes right or depth pictures as FOLDER/NNNNNN.png by frame number, without those of no frame (-1).

    `folder`: is created; `frames`: (M,); `pictures`: M of uint8 (H, W, 3), or of depth (H, W): uint16, or
    float32 as .npy. An odd last row or column is left out, as in the video.
    """
    folder.mkdir()
    for frame, picture in zip(frames, pictures, strict=True):
        if frame < 0:
            continue
        even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
        if even.dtype.kind == "f":
            np.save(folder / f"{frame:06d}.npy", even)
        else:
            as_stored = np.ascontiguousarray(even[..., ::-1] if even.ndim == 3 else even)
            (folder / f"{frame:06d}.png").write_bytes(cv2.imencode(".png", as_stored)[1].tobytes())


def write_video(
    path: Path,
    pictures: Iterator[Pixels],
    times_s: Floats,
    crf: int = 12,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Writes H.264 MP4 with each frame at its own time, to 1 ms; an odd last row or column is left out.

    `pictures`: (H, W, 3) uint8 each, as many as `times_s`, (T,) rising [s]; `crf`: x264's quality, 0 is
    lossless (4:4:4 colour); `progress`: called with the number of frames written.
    """
    options = {"crf": str(crf), "threads": "1"}
    rate = max(1, round((len(times_s) - 1) / max(times_s[-1] - times_s[0], 1e-3)))

    def even() -> Iterator[Pixels]:
        for k, rgb in enumerate(pictures):
            yield rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
            progress(k + 1)

    # After "file:" a colon in the path does not start a protocol.
    with av.open(f"file:{path}", "w", format="mp4") as container:
        encode(container, even(), rate, "yuv444p" if crf == 0 else "yuv420p", options, times_s=times_s)


def _csv(path: Path, head: str, line: str, rows: Floats) -> None:
    np.savetxt(path, rows, fmt=line, header=head, comments="")
