"""JPEG as a photograph went through it, and the H.264 that takes as much from a picture."""

from __future__ import annotations

import io
from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image, JpegImagePlugin

from synth.fit.statistics import Picture
from synth.job.schema import SensorSection
from synth.render.camera import video_link

_UNSEEN_DB = 46.0  # a loss below this is less than rounding to 8 bits of a noisy picture
_BITRATES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # Mbit/s of a 640 x 480 video
_VIDEO_PX = 640 * 480
_SAMPLING = ("4:4:4", "4:2:2", "4:2:0")


@dataclass(frozen=True)
class Compression:
    """How a picture file was packed."""

    tables: tuple[tuple[int, ...], ...] = ()
    """JPEG's quantisation of light and colour, 64 steps each; empty: none."""
    chroma: str = "4:4:4"
    finer: float = 1.0
    """Pixels of the file over those of the scale that is measured at."""

    @classmethod
    def of_file(cls, data: bytes, finer: float) -> Compression:
        """As the head of the file has it."""
        with Image.open(io.BytesIO(data)) as image:
            if not isinstance(image, JpegImagePlugin.JpegImageFile):
                return cls(finer=finer)
            sampling = max(0, JpegImagePlugin.get_sampling(image))
            tables = tuple(tuple(int(v) for v in table) for table in image.quantization.values())
            return cls(tables, _SAMPLING[sampling], finer)

    def apply(self, rgb: Picture) -> Picture:
        """A picture (H, W, 3) packed so at the file's own size, and brought back."""
        if not self.tables:
            return rgb
        height, width = rgb.shape[:2]
        size = (round(width * self.finer), round(height * self.finer))
        packed = io.BytesIO()
        large = Image.fromarray(cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC))
        tables = [list(table) for table in self.tables[:2]]
        large.save(packed, "JPEG", qtables=tables, subsampling=_SAMPLING.index(self.chroma))
        back = np.asarray(Image.open(packed).convert("RGB"))
        return np.asarray(cv2.resize(back, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def bitrate_mbps(self, rgb: Picture) -> float | None:
        """The rate, for 640 x 480, at which H.264 takes as much from a picture; None: nothing that is seen.

        Args:
            rgb: (H, W, 3) a rendered frame that was not packed.
        """
        lost = _ratio_db(rgb, self.apply(rgb))
        if lost > _UNSEEN_DB:
            return None
        noise = np.random.default_rng(0).normal(0, 2, (5, *rgb.shape))
        film = np.clip(rgb + noise, 0, 255).astype(np.uint8)
        share = rgb.shape[0] * rgb.shape[1] / _VIDEO_PX
        left = []
        for rate in _BITRATES:
            sensor = SensorSection.model_validate({"bitrate_mbps": rate * share, "chroma": self.chroma})
            left.append(_ratio_db(film, video_link.recorded(film, sensor, 25.0)))
        rate = float(np.exp(np.interp(lost, np.maximum.accumulate(left), np.log(_BITRATES))))
        return float(f"{rate:.3g}")


def _ratio_db(before: Picture, after: Picture) -> float:
    """Peak signal to noise [dB]."""
    error = float(((before.astype(np.float64) - after) ** 2).mean())
    return 99.0 if error == 0 else float(10 * np.log10(255**2 / error))
