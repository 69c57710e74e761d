"""The video writer: H.264 encoding."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fractions import Fraction
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from synth.arrays import Floats, Pixels
from synth.errors import UserError
from synth.system import checked_file

if TYPE_CHECKING:
    from av.container import OutputContainer

_TICKS = 90_000  # a second


def encode_video(
    target: Path, frames: Iterable[Pixels], fps: float, *, quality: int = 23, group: int = 12
) -> Path:
    """Writes (H, W, 3) uint8 sRGB frames as an MP4 (H.264, 4:2:0, BT.601) that browsers can play.

    An odd last row or column is cropped. `quality`: x264's rate factor; `group`: distance of key frames.
    """
    import av

    # Without these, players assume BT.709 for large pictures and show wrong colours.
    colours = {"colorspace": "smpte170m", "color_primaries": "bt709", "color_trc": "iec61966-2-1"}
    options = {"crf": str(quality), "g": str(group), "threads": "1", **colours, "color_range": "tv"}
    # With "file:" a colon in the path is not taken for a protocol.
    with checked_file.part_of(target) as part, av.open(f"file:{part}", "w", format="mp4") as container:
        even = (picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2] for picture in frames)
        encode(container, even, Fraction(fps).limit_denominator(1000), "yuv420p", options)
    return target


def encode(
    container: OutputContainer,
    frames: Iterable[Pixels],
    rate: Fraction | int,
    pixels: str,
    options: Mapping[str, str],
    *,
    bits_per_s: int | None = None,
    times_s: Floats | None = None,
) -> None:
    """Encodes frames, (H, W, 3) uint8 sRGB, with H.264 as the only stream of an open file.

    `pixels`: FFmpeg's format; where it subsamples chroma, H and W are even. `options`: x264's; `times_s`:
    (T,) rising, by the rate if None. UserError: frames of different sizes, or without pixels.
    """
    import av

    stream = container.add_stream("libx264", rate=rate, options=dict(options))
    stream.pix_fmt = pixels
    if bits_per_s is not None:
        stream.bit_rate = bits_per_s
    if times_s is not None:
        stream.codec_context.time_base = stream.time_base = Fraction(1, _TICKS)
    times = repeat(None) if times_s is None else times_s - times_s[0]
    for k, (rgb, time_s) in enumerate(zip(frames, times, strict=times_s is not None)):
        if k == 0:
            stream.height, stream.width = rgb.shape[:2]
        if rgb.shape[:2] != (stream.height, stream.width) or not rgb.size:
            other = f"{rgb.shape[1]} x {rgb.shape[0]} px"
            raise UserError(f"{container.name}: frame {k} has another size, {other}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        if time_s is not None:
            frame.pts, frame.time_base = round(float(time_s) * _TICKS), Fraction(1, _TICKS)
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))
