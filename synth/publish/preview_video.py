"""A short film of a dataset: some of its sequences side by side, as `preview.mp4`."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Dataset
from synth.system import whole_file

_LARGEST_PX = 1280
_TILES = 9


def path(root: Path) -> Path:
    """Where it lies."""
    return root / "preview.mp4"


def write_preview(root: Path) -> Path | None:
    """Makes the film from up to nine sequences spread over the dataset; None when nothing is finished."""
    if not any(root.glob("[0-9]*.zarr")):
        return None
    dataset = Dataset(root)
    chosen = np.unique(np.linspace(0, len(dataset) - 1, _TILES).round().astype(int))
    columns = int(np.ceil(np.sqrt(len(chosen))))
    videos = [dataset[int(k)] for k in chosen]
    height, width = videos[0].size
    step = max(1, -(-columns * width // _LARGEST_PX))
    rows = -(-len(videos) // columns)
    frames = max(video.frames for video in videos)
    tall, wide = len(range(0, height, step)), len(range(0, width, step))
    film = np.zeros((frames, rows * tall, columns * wide, 3), np.uint8)
    for k, video in enumerate(videos):
        top, left = k // columns * tall, k % columns * wide
        for t in range(frames):
            picture = video["rgb"][min(t, video.frames - 1)]
            film[t, top : top + tall, left : left + wide] = picture[::step, ::step]
    return encode_video(path(root), film, float(videos[0].attrs["fps"]))


def encode_video(target: Path, film: NDArray[np.uint8], fps: float) -> Path:
    """Writes (T, H, W, 3) uint8 frames as an MP4 that browsers play."""
    import av

    film = film[:, : film.shape[1] // 2 * 2, : film.shape[2] // 2 * 2]
    # By "file:" a colon in the path is no protocol.
    with whole_file.part_of(target) as part, av.open(f"file:{part}", "w", format="mp4") as container:
        stream: Any = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1000))
        stream.height, stream.width = film.shape[1:3]
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "23", "threads": "1"}
        for picture in film:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return target
