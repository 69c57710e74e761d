"""The video link between camera and recorder: H.264 at a bitrate, encoded and decoded."""

from __future__ import annotations

import io
from fractions import Fraction

import numpy as np

from synth.arrays import Pixels
from synth.errors import UserError
from synth.video.write_video import encode

_FORMATS = {"4:4:4": "yuv444p", "4:2:2": "yuv422p", "4:2:0": "yuv420p"}


def transmit(pictures: Pixels, fps: float, bitrate_mbps: float | None, chroma: str = "4:4:4") -> Pixels:
    """Pictures (T, H, W, 3) sRGB after the recorder's codec; the same pictures without a bitrate.

    Deterministic, since it runs on one thread. UserError: the codec rejects this size or kind of picture.
    """
    if bitrate_mbps is None:
        return pictures
    import av

    height, width = pictures.shape[1:3]
    # With subsampled chroma codecs accept even sizes only.
    even_pictures = np.pad(pictures, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    buffer = io.BytesIO()
    try:
        with av.open(buffer, "w", format="matroska") as container:
            options = {"threads": "1", "preset": "medium", "tune": "zerolatency"}
            rate, bits_per_s = Fraction(fps).limit_denominator(1000), round(bitrate_mbps * 1e6)
            encode(container, even_pictures, rate, _FORMATS[chroma], options, bits_per_s=bits_per_s)
        buffer.seek(0)
        with av.open(buffer) as container:
            # Bilinear from subsampled chroma, as players do; the default of nearest leaves blocks.
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except av.FFmpegError as error:
        raise UserError(f"sensor.bitrate_mbps: the codec rejects this video ({error})") from error
    return np.stack(frames)[:, :height, :width]
