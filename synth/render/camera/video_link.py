"""The video link between camera and recorder: H.264 at a bitrate, there and back."""

from __future__ import annotations

import io
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from synth.errors import UserError
from synth.job import schema
from synth.video.write import encode

Pictures = npt.NDArray[np.uint8]

_FORMATS = {"4:4:4": "yuv444p", "4:2:2": "yuv422p", "4:2:0": "yuv420p"}


def recorded(pictures: Pictures, section: schema.SensorSection, fps: float) -> Pictures:
    """What a recorder gives back of pictures (T, H, W, 3) sRGB; the same pictures without a bitrate.

    One thread and no look at the clock: the same bytes every time.

    Raises:
        UserError: the codec refuses pictures of this size or kind.
    """
    if section.bitrate_mbps is None:
        return pictures
    import av

    height, width = pictures.shape[1:3]
    # Codecs take even sizes only when they thin out chroma.
    padded = np.pad(pictures, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    buffer = io.BytesIO()
    try:
        with av.open(buffer, "w", format="matroska") as container:
            options = {"threads": "1", "preset": "medium", "tune": "zerolatency"}
            rate, bits_per_s = Fraction(fps).limit_denominator(1000), round(section.bitrate_mbps * 1e6)
            encode(container, padded, rate, _FORMATS[section.chroma], options, bits_per_s=bits_per_s)
        buffer.seek(0)
        with av.open(buffer) as container:
            # Bilinear from subsampled chroma, as players do; the default of nearest leaves blocks.
            back = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except av.FFmpegError as error:
        raise UserError(f"sensor.bitrate_mbps: the codec refused this video ({error})") from error
    return np.stack(back)[:, :height, :width]
