"""A short film of a dataset: some of its sequences side by side, as `preview.mp4`."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Dataset, Sequence
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
    height, width = _picture(videos[0], 0).shape[:2]
    step = max(1, -(-columns * width // _LARGEST_PX))
    rows = -(-len(videos) // columns)
    frames = max(video.frames for video in videos)
    tall, wide = len(range(0, height, step)), len(range(0, width, step))
    film = np.zeros((frames, rows * tall, columns * wide, 3), np.uint8)
    for k, video in enumerate(videos):
        top, left = k // columns * tall, k % columns * wide
        for t in range(frames):
            picture = _picture(video, min(t, video.frames - 1))
            film[t, top : top + tall, left : left + wide] = picture[::step, ::step]
    return encode_video(path(root), film, float(videos[0].attrs["fps"]))


def _picture(video: Sequence, t: int) -> NDArray[np.uint8]:
    """Frame t (H, W, 3); of a stereo sequence (H, 2W, 3), the left eye beside the right."""
    if "rgb_right" not in video:
        return video["rgb"][t]
    return np.hstack([video["rgb"][t], video["rgb_right"][t]])


def encode_video(
    target: Path, film: Iterable[NDArray[np.uint8]], fps: float, *, quality: int = 23, group: int = 12
) -> Path:
    """Writes (H, W, 3) uint8 sRGB frames as an MP4 (H.264, 4:2:0, BT.601) that browsers play.

    Args:
        target: the file.
        film: at least one frame, all of one size; an odd last row or column is left out, as the codec takes
            even sizes only.
        fps: frames a second.
        quality: x264's constant rate factor: less is better and larger.
        group: frames from one that can be decoded by itself to the next.
    """
    import av

    # By "file:" a colon in the path is no protocol.
    with whole_file.part_of(target) as part, av.open(f"file:{part}", "w", format="mp4") as container:
        stream: Any = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1000))
        # Unsaid, players take large pictures for BT.709 and show other colours than were put in.
        told = {"colorspace": "smpte170m", "color_primaries": "bt709", "color_trc": "iec61966-2-1"}
        packing = {"crf": str(quality), "g": str(group), "threads": "1"}
        stream.pix_fmt, stream.options = "yuv420p", {**packing, **told, "color_range": "tv"}
        for k, picture in enumerate(film):
            even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
            if k == 0:
                stream.height, stream.width = even.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return target
