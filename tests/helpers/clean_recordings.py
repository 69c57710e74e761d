"""Recordings without a fault, of several codecs, sizes, cameras and sensors: no finding is true of them.

An elastic half-space is pressed and dragged by a rod that enters, touches twice and leaves (point loads of
Boussinesq and Cerruti, smoothed over a patch; K. L. Johnson, Contact Mechanics, 1985, 3.2 and 3.6). The
sensor has an offset, white noise, another rate and axes than the camera's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from fake_recording import texture
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from bench.recording import recording_writer

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8]

FPS, SECONDS = 25.0, 5.2
WIDTH_MM, YOUNG_KPA, POISSON, PATCH_MM = 32.0, 2.0, 0.4, 3.0
TURN = Rotation.from_euler(
    "xyz", (35, -50, 110), degrees=True
).as_matrix()  # from the camera's to sensor axes
OFFSET_MN = -22.6 * TURN @ np.array([0.4, 0.1, 0.9]) / 0.99  # against the loads: the raw size falls with them
CODECS = "mp4v", "h264", "mjpeg", "png"
SIZES = (96, 128), (120, 160), (144, 192), (192, 256)
SENSORS = "plain", "offset", "ati"
FREE_S = (0.0, 0.8), (4.5, 5.1)


@dataclass(frozen=True)
class Case:
    """One recording."""

    codec: str = "png"
    size: tuple[int, int] = SIZES[1]
    sensor: str = "offset"
    colour: str = ""  # of the camera: "", "white balance" or "10 bits"
    masks: bool = True
    seed: int = 0

    @property
    def name(self) -> str:
        masks = "masks" if self.masks else "no-masks"
        parts = (
            self.codec,
            f"{self.size[1]}x{self.size[0]}",
            self.sensor,
            self.colour.replace(" ", "-"),
            masks,
        )
        return "-".join(part for part in parts if part)


def all_cases() -> list[Case]:
    """24 recordings: each codec with each sensor, with masks and without, sizes and colours in turn."""
    cases = list[Case]()
    for k, codec in enumerate(CODECS):
        for j, sensor in enumerate(SENSORS):
            for masks in (True, False):
                colour = ("", "white balance", "10 bits" if codec == "png" else "")[(j + masks) % 3]
                size = SIZES[(k + j + 2 * masks) % len(SIZES)]
                cases.append(Case(codec, size, sensor, colour, masks, len(cases)))
    return cases


def load_mn(time_s: Floats) -> Floats:
    """Force (T, 3) mN on the tissue, camera axes: a press that drags to the right, one that drags upwards."""
    first, second = _hold(time_s, 1.2, 2.4), _hold(time_s, 2.9, 4.1)
    forces = np.outer(first, [25.0, 8.0, 45.0]) + np.outer(second, [-6.0, -30.0, 30.0])
    return np.asarray(forces, np.float64)


def _hold(time_s: Floats, start: float, stop: float) -> Floats:
    """A load in 0..1 that rises and falls in 0.4 s."""
    rise = np.clip(np.minimum(time_s - start, stop - time_s) / 0.4, 0, 1)
    return np.asarray(rise * rise * (3 - 2 * rise))


class Scene:
    """Rest picture and motion of the tissue."""

    def __init__(self, size: tuple[int, int], seed: int) -> None:
        self.size, self.mm_per_px = size, WIDTH_MM / size[1]
        rng, (height, width) = np.random.default_rng(seed), size
        rest = texture(height, width, seed).astype(np.float32)
        for _ in range(7):  # vessels
            x, y = (
                np.linspace(-10, width + 10, 40),
                rng.uniform(0, height) + np.cumsum(rng.normal(0, 2.0, 40)),
            )
            line = np.rint(np.stack([x, y], -1)).astype(np.int32) if rng.random() < 0.6 else None
            line = (
                np.rint(np.stack([y * width / height, x * height / width], -1)).astype(np.int32)
                if line is None
                else line
            )
            cv2.polylines(rest, [line], False, (120, 40, 45), max(1, width // 80), cv2.LINE_AA)
        self.rest = np.clip(cv2.GaussianBlur(rest, (0, 0), 0.6), 0, 225)
        self.contact = np.array([0.55 * width, 0.5 * height])
        self.rng = rng

    def motion_px(self, force_mn: Floats, points: Floats) -> Floats:
        """Motion (H, W, 2) px of `points` (H, W, 2) px under a load at the contact."""
        shear_kpa = YOUNG_KPA / (2 * (1 + POISSON))
        x, y = np.moveaxis((points - self.contact) * self.mm_per_px, -1, 0)
        r = np.sqrt(x * x + y * y + PATCH_MM**2)
        fx, fy, fz = force_mn / (4 * np.pi * shear_kpa)
        radial = 2 * (fx * x + fy * y) * POISSON / r**3 - (1 - 2 * POISSON) * fz / r**2
        ux, uy = 2 * (1 - POISSON) * fx / r + radial * x, 2 * (1 - POISSON) * fy / r + radial * y
        return np.asarray(np.stack([ux, uy], -1) / self.mm_per_px)

    def draw(self, time_s: float) -> tuple[Floats, NDArray[np.bool_]]:
        """The picture (H, W, 3) without noise, and the rod's mask (H, W)."""
        height, width = self.size
        force = load_mn(np.array([time_s]))[0]
        places = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
        displacement = self.motion_px(force, places - self.motion_px(force, places))
        source = (places - displacement).astype(np.float32)
        picture = cv2.remap(
            self.rest, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        away = 1 - _hold(np.array([time_s]), 0.75, 4.55)[0]
        tip = (
            self.contact
            + self.motion_px(force, self.contact[None, None])[0, 0]
            + away * np.array([0.65, -0.3]) * width
        )
        rod = np.zeros(self.size, np.uint8)
        shade, rod_px = rod.copy(), max(5, width // 20)
        shaft_end = tip + 2.0 * width * np.array([0.9, -0.42])
        for canvas, shift in ((shade, rod_px // 3), (rod, 0)):
            start, stop = ([int(v) for v in np.rint(16 * (end + shift))] for end in (tip, shaft_end))
            cv2.line(canvas, start, stop, 255, rod_px, cv2.LINE_AA, 4)
        picture = picture * (1 - 0.3 * cv2.GaussianBlur(shade, (0, 0), 2)[..., None] / 255.0)
        steel = np.array([150.0, 155.0, 160.0]) + 25 * np.sin(places[..., :1] / 7)
        alpha = rod[..., None] / 255.0
        return np.asarray((1 - alpha) * picture + alpha * steel), rod > 60

    def take(self, time_s: float, colour: str) -> tuple[Floats, NDArray[np.bool_]]:
        """The picture (H, W, 3) in 0..255 with noise, and the rod's mask."""
        clean, rod = self.draw(time_s)
        gains = np.array([0.8, 1.0, 1.45]) if colour == "white balance" else np.ones(3)
        return np.clip(clean * gains + self.rng.normal(0, 1.5, clean.shape), 0, 255), rod


def make(root: Path, case: Case) -> Path:
    """Writes a recording folder."""
    folder = root / case.name
    folder.mkdir(parents=True)
    time_s, scene = np.arange(round(SECONDS * FPS)) / FPS, Scene(case.size, case.seed)
    shots = [scene.take(float(t), case.colour) for t in time_s]
    write_pictures(folder, case, [picture for picture, _ in shots], time_s)
    if case.masks:
        (folder / "masks").mkdir()
        for k, (_, rod) in enumerate(shots):
            cv2.imwrite(str(folder / "masks" / f"{k:06d}.png"), rod.astype(np.uint8) * 255)
        cv2.imwrite(str(folder / "tissue.png"), np.full(case.size, 255, np.uint8))
    sensor = write_sensor(folder, case)
    recording_writer.write_meta(
        folder,
        {
            "scale_mm_per_px": scene.mm_per_px,
            "young_kpa": YOUNG_KPA,
            "tissue": "ex-vivo",
            "membrane": "stripped",
            "poisson": [POISSON, POISSON],
            "sensor": sensor,
        },
    )
    return folder


def write_pictures(folder: Path, case: Case, pictures: list[Floats], time_s: Floats) -> None:
    """Writes the video, or pictures with their times."""
    height, width = case.size
    pictures_8bit = [np.rint(picture).astype(np.uint8) for picture in pictures]
    if case.codec == "png":
        (folder / "frames").mkdir()
        for k, picture in enumerate(pictures):
            levels = np.rint(picture * 4).astype(np.uint16) if case.colour == "10 bits" else pictures_8bit[k]
            cv2.imwrite(str(folder / "frames" / f"{k:06d}.png"), np.ascontiguousarray(levels[..., ::-1]))
        recording_writer.write_frames(folder, time_s)
    elif case.codec == "mp4v":
        video = cv2.VideoWriter(
            str(folder / "video.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (width, height)
        )
        for rgb in pictures_8bit:
            video.write(np.ascontiguousarray(rgb[..., ::-1]))
        video.release()
    else:
        h264 = case.codec == "h264"
        with av.open(str(folder / ("video.mp4" if h264 else "video.avi")), "w") as container:
            options = {"crf": "23", "g": "12", "threads": "1"} if h264 else {"qscale": "4"}
            stream = container.add_stream("libx264" if h264 else "mjpeg", rate=Fraction(FPS), options=options)
            stream.width, stream.height = width, height
            stream.pix_fmt = "yuv420p" if h264 else "yuvj420p"
            for packet in _encode(stream, pictures_8bit):
                container.mux(packet)


def _encode(stream: av.VideoStream, pictures: list[Pixels]) -> Iterator[av.Packet]:
    for picture in pictures:
        yield from stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24"))
    yield from stream.encode()


def write_sensor(folder: Path, case: Case, drift_mn_per_s: float = 0.0) -> dict[str, object]:
    """Writes force.csv; returns the keys of meta.yaml's `sensor`."""
    rate_hz, noise_mn = {"plain": (62.5, 0.15), "offset": (100.0, 2.4), "ati": (1000.0, 4.0)}[case.sensor]
    t = np.arange(0, SECONDS, 1 / rate_hz)
    values = load_mn(t) + drift_mn_per_s * np.outer(t, [0.6, 0.0, 0.8])
    about: dict[str, object] = {"axes": "camera"}
    if case.sensor != "plain":
        values = values @ TURN.T + OFFSET_MN
        about = {"free_s": [list(FREE_S[0])]}
        if case.sensor == "ati":
            about["to_camera"] = TURN.T.tolist()
    noise = np.random.default_rng(100 + case.seed).normal(0, noise_mn, values.shape)
    recording_writer.write_force(folder, t, (values + noise) / 1000)
    return about


class Fit:
    """The load at the known contact that fits the flow best, with an interval of 40%; a method to score."""

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        height, width = frame.confidence.shape
        rest_scene = Scene((height, width), 0)
        places = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)[::4, ::4].astype(float)
        weight = frame.confidence[::4, ::4, None]
        fields = [(weight * rest_scene.motion_px(axis, places)).ravel() for axis in np.eye(3)]
        flow = (weight * frame.flow[::4, ::4]).ravel()
        force = np.linalg.lstsq(np.stack(fields, -1), flow, rcond=None)[0]
        size = float(np.linalg.norm(force))
        return ForceEstimate(
            force, np.zeros((height, width), np.float32) if picture else None, 0.6 * size, 1.4 * size + 2
        )
