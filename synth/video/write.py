"""Films written so that browsers play them."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.system import checked_file


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
    with checked_file.part_of(target) as part, av.open(f"file:{part}", "w", format="mp4") as container:
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
