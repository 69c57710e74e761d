"""Segmentation of what is not tissue: instruments and other objects in front of it, shadows and highlights.

A U-Net (O. Ronneberger et al., MICCAI 2015) takes a frame together with the rest frame, so that it sees what
appeared, and returns a probability per class and pixel. It was trained on domain-randomised renders and on
instruments, shadows and objects drawn over other pictures (D. Dwibedi et al., "Cut, paste and learn", ICCV
2017); `python -m weights make` trains such a network, the card next to the weights says from what.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.special import expit

from synth.arrays import Map, Mask, Pixels
from synth.flow import onnx_network

WEIGHTS = Path(__file__).with_name("segmentation.onnx")
CLASSES = "instrument", "shadow", "highlight"
CHANNELS = 6  # of the network's input: the frame and the rest frame
SIDE = 256  # px, longest side of the pictures in which classes are predicted: what it learnt is of one scale
_MULTIPLE = 32  # px: the levels of the network need multiples of it on both sides
_PRESENT = 0.5  # probability above which a class is taken to be there
_HIDING = 0.9  # and above which an instrument is taken to hide tissue, whose motion would be lost (design.md)


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Probabilities (H, W) float32 in 0..1 of each class in a frame."""

    instrument: Map  # or another object in front of the tissue
    shadow: Map  # of an instrument
    highlight: Map

    @property
    def objects(self) -> Mask:
        """(H, W) instruments and other objects."""
        return np.asarray(self.instrument > _PRESENT)

    @property
    def hidden(self) -> Mask:
        """(H, W) where an object or a highlight hides the tissue, and a pixel around."""
        return _dilate((self.instrument > _HIDING) | (self.highlight > _PRESENT))

    @property
    def glare(self) -> Mask:
        """(H, W) highlights and a pixel around."""
        return _dilate(self.highlight > _PRESENT)

    def expect(self, expected: Mask) -> Segmentation:
        """The classes where an object is expected (H, W): its odds there are those of 0.9 where they were
        even."""
        odds = _HIDING / (1 - _HIDING)
        posterior = odds * self.instrument / (1 + (odds - 1) * self.instrument)
        return replace(self, instrument=np.where(expected, posterior, self.instrument).astype(np.float32))


def segment(rest: Pixels, frame: Pixels) -> Segmentation:
    """The classes of a frame (H, W, 3) uint8, given the rest frame of the same size."""
    height, width = frame.shape[:2]
    share = SIDE / max(height, width)
    size = max(1, round(width * share)), max(1, round(height * share))
    mode = cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC
    pictures = [cv2.resize(picture, size, interpolation=mode) for picture in (frame, rest)]
    probabilities = expit(onnx_network.run(WEIGHTS, prepare(*pictures))[:, : size[1], : size[0]])
    return Segmentation(*(cv2.resize(plane, (width, height)) for plane in probabilities))


def with_highlights(video: Pixels, tools: Mask) -> Mask:
    """Masks (T, H, W) of a video (T, H, W, 3) from its rest frame on: given instruments, found highlights."""
    glare = np.stack([segment(video[0], picture).glare for picture in video])
    return np.asarray(tools | glare, bool)


def prepare(frame: Pixels, rest: Pixels) -> Map:
    """Input (6, H', W') of the network: each picture (H, W, 3) with mean 0 and deviation 1, padded."""
    height, width = frame.shape[:2]
    margins = 0, -height % _MULTIPLE, 0, -width % _MULTIPLE
    planes: list[Map] = []
    for picture in (frame, rest):
        mean, deviation = cv2.meanStdDev(picture)
        scale = 1 / (np.sqrt((deviation**2).mean() + mean.var()) + 8.0)
        extended = cv2.copyMakeBorder(picture, *margins, cv2.BORDER_REPLICATE)
        planes += [(plane - np.float32(mean.mean())) * np.float32(scale) for plane in cv2.split(extended)]
    return np.stack(planes)


def _dilate(mask: Mask) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
