"""Stereo recordings with a force sensor, simulated and rendered by other programs.

Mechanics by felupe (triquadratic bricks, compressible neo-Hookean, Hertz's pressure; a membrane as a net of
trusses; a pulse applied to the ground; two tools at a time), images by Blender's Cycles. This module
contributes texture, the tools' shape and motion, the sensor and the folder's layout. They are scored by
`bench score` and `bench pool` in stereo, and monocular without their right camera.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import KroghInterpolator, LinearNDInterpolator, RectBivariateSpline
from scipy.ndimage import gaussian_filter
from scipy.spatial import Delaunay

from bench.recording import recording_writer
from evidence import report
from evidence.pooled import FOLDERS, copy_left, score_and_pool
from evidence.scoring.exvivo import ramp
from evidence.study import Study
from synth.arrays import Floats, Map, Pixels
from synth.errors import UserError
from synth.system import checked_file
from synth.system.checked_file import read_picture

KINDS = ("plain", "membrane", "pulse", "two")
_WORKER = Path(__file__).with_name("foreign_worker.py")
_FIELD_MM, _SIDE, _TEXELS, _SIZE = 46.0, 220, 1200, (320, 240)
_DISTANCE_MM, _BASE_MM, _SENSOR_HZ = 300.0, 24.0, 100.0
_STILL_S, _CONTACTS, _HOVER_MM = 2.0, 4, 45.0
# Directions of a left and a right tool's shaft; a single one is the right one.
_SHAFTS = np.array([[-0.5, -0.6, 1.0], [0.5, -0.6, 1.0]]) / np.linalg.norm([0.5, -0.6, 1.0])
_APART_MM = 8.0  # half of the distance of two tools, on average
_VIDEOS = {"": "video.mp4", "right-": "right.mp4"}  # prefix of a camera's images, and its video
TRUTH = "truth.npz"  # of every frame: `flow_px` (T, H, W, 2), of the contacts alone, and `force_mn` (T, 3)
_HEART_HZ, _BREATH_HZ = 1.2, 0.25


def measure(
    recordings: Path,
    mechanics_python: Path,
    pictures_python: Path,
    kinds: str = "plain,plain,membrane,membrane,pulse,two",
    seeds: str = "907,20261129",
    seconds: float = 8.0,
    fps: float = 3.0,
    spp: int = 16,
    results: Path = report.RESULTS / "learn/foreign",
) -> None:
    """Makes recordings in the folder `recordings`, and scores them into `results`.

    `mechanics_python`, `pictures_python`: a Python with felupe and pypardiso, and one with bpy; `kinds`: of
    the recordings of each of `seeds`, whose second has numbers from 10 on; `spp`: light paths a pixel.
    """
    folders = {cameras: list[Path]() for cameras in FOLDERS}
    for (part_number, seed), (index, kind) in product(enumerate(seeds.split(",")), _number(kinds.split(","))):
        name = f"{kind}-{10 * part_number + index}"
        stereo, mono = (recordings / FOLDERS[cameras] / name for cameras in (2, 1))
        if not stereo.exists():
            with checked_file.folder_of(stereo) as part:
                rng = np.random.default_rng([int(seed), KINDS.index(kind), index])
                record(part, stereo.name, kind, rng, (seconds, fps, spp), (mechanics_python, pictures_python))
        copy_left(stereo, mono)
        folders[2].append(stereo)
        folders[1].append(mono)
    for cameras, paths in folders.items():
        score_and_pool(paths, cameras, results / FOLDERS[cameras])


def _number(kinds: Sequence[str]) -> list[tuple[int, str]]:
    """Each kind with its number among those of the same kind."""
    return [(kinds[:k].count(kind), kind) for k, kind in enumerate(kinds)]


def record(
    part: Path,
    name: str,
    kind: str,
    rng: np.random.Generator,
    video: tuple[float, float, int],
    pythons: tuple[Path, Path],
) -> None:
    """Writes one recording of a kind of `KINDS` into the folder `part`.

    `video`: length [s], frames a second, light paths a pixel; `pythons`: of mechanics and of images.
    """
    seconds, fps, spp = video
    times = np.arange(0, seconds, 1 / fps)
    young = float(np.exp(rng.uniform(np.log(0.8), np.log(6.0))))
    contacts = [_tools(young, 1 + (kind == "two"), rng) for _ in range(_CONTACTS)]
    specimen = {
        "block_mm": (90.0, 50.0),
        "elements": (12, 7),
        "levels": 3,
        "young_kpa": young,
        "poisson": float(rng.uniform(0.42, 0.48)),
        "membrane_mn_per_mm": float(rng.uniform(5, 40)) if kind == "membrane" else 0.0,
        "pulse_mm": float(rng.uniform(0.15, 0.4)) if kind == "pulse" else 0.0,
        "contacts": contacts,
    }
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        surface = Surface.of(np.load(run(pythons[0], folder, "mechanics", specimen)), rng)
        sensor_s, level, away = tool_motion(seconds, rng)
        # The sensor's sample of each frame.
        samples = np.minimum((times * _SENSOR_HZ).astype(int), len(level) - 1)
        arrays = _scene(surface, level[samples], away[samples], times, contacts, rng)
        camera, focal = first_camera(rng)
        flow = [project_flow(surface.rest, surface.at(level[k], 0.0), camera, focal) for k in samples]
        pair = camera, right_camera(camera)
        settings = {
            "size": _SIZE,
            "focal_px": focal,
            "cameras": {prefix: matrix.tolist() for prefix, matrix in zip(_VIDEOS, pair, strict=True)},
            "spp": spp,
            "threads": 1,
            "tool_mm": 0.6 * min(tool["radius_mm"] for contact in contacts for tool in contact),
            "lamps_mm": [[70.0, 40.0, 260.0], [-60.0, 20.0, 280.0]],
            "watts": 2.6e5,
        }
        run(pythons[1], folder, "pictures", settings, arrays)
        noise = np.random.default_rng(rng.integers(2**31))
        for prefix, file in _VIDEOS.items():
            pictures = (_read_with_noise(folder / f"{prefix}{k:05d}.png", noise) for k in range(len(times)))
            recording_writer.write_video(part / file, pictures, times, crf=18)
    force = level @ np.array([np.sum([tool["force_mn"] for tool in contact], axis=0) for contact in contacts])
    measured = force @ camera[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    np.savez_compressed(part / TRUTH, flow_px=np.array(flow, np.float16), force_mn=measured[samples])
    measured = measured + 0.02 * rng.normal(size=(len(sensor_s), 3))
    recording_writer.write_force(part, sensor_s, measured / 1000)
    write_pair(part / "pair.yaml", *pair, focal)
    recording_writer.write_meta(part, _about(name, young, focal))


def _about(name: str, young: float, focal: float) -> dict[str, Any]:
    """The recording's `meta.yaml`."""
    return {
        "stereo": {"calibration": "pair.yaml"},
        "scale_mm_per_px": _DISTANCE_MM / focal,
        "young_kpa": young,
        "specimen": name,
        "sensor": {"axes": "camera", "acts_on": "tissue", "free_s": [[0.1, _STILL_S - 0.2]]},
        "sync": {"method": "clock"},
    }


def run(
    python: Path, folder: Path, work: str, settings: dict[str, Any], arrays: dict[str, Any] | None = None
) -> Path:
    """Runs the worker in its own Python; returns the file it wrote. Raises UserError with its last line."""
    (folder / f"{work}.json").write_text(json.dumps(settings))
    if arrays is not None:
        np.savez(folder / f"{work}.npz", **arrays)
    process = subprocess.run([python, _WORKER, work, folder], capture_output=True, text=True, check=False)
    if process.returncode:
        last = (process.stderr.strip() or process.stdout.strip() or "no message").splitlines()[-1]
        raise UserError(f"{python}: {work}: {last}")
    return folder / f"{work}.npz"


def _tools(young: float, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """One contact, or two at a time, left and right of the centre."""
    tools = [_contact(young, rng) for _ in range(count)]
    if count == 2:
        for tool, side in zip(tools, (-1, 1), strict=True):
            tool["at_mm"][0] = side * (_APART_MM + tool["at_mm"][0] / 3)
    return tools


def _contact(young: float, rng: np.random.Generator) -> dict[str, Any]:
    """A press, a lateral push or a pull near the centre of the field; P = F/(E a²) of 0.06 to 0.3."""
    radius = float(rng.uniform(3, 6))
    size = float(rng.uniform(0.06, 0.3)) * young * radius**2
    tilt, turn = np.deg2rad(rng.uniform(0, 55)), rng.uniform(0, 2 * np.pi)
    direction = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    if rng.random() < 0.7:
        direction[2] *= -1
    force = size * direction
    return {"at_mm": rng.uniform(-6, 6, 2).tolist(), "radius_mm": radius, "force_mn": force.tolist()}


def tool_motion(seconds: float, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """One contact after the other, each with a rise, a hold and a fall; still at both ends.

    Returns:
        The sensor's times [s] (N,), shares of each contact's force (N, contacts), and the distance of its tip
        from the tissue, 0 to 1 (N, contacts).
    """
    time = np.arange(0, seconds, 1 / _SENSOR_HZ)
    level, away = np.zeros((len(time), _CONTACTS)), np.ones((len(time), _CONTACTS))
    slot = (seconds - 2 * _STILL_S) / _CONTACTS
    for k in range(_CONTACTS):
        start = _STILL_S + k * slot
        rise, fall = rng.uniform(0.25, 0.4) * slot, rng.uniform(0.2, 0.3) * slot
        end = start + 0.9 * slot
        level[:, k] = ramp((time - start) / rise) * ramp((end - time) / fall)
        level[:, k] *= rng.uniform(0.6, 1.0)
        away[:, k] = np.maximum(ramp((start - time) / 0.4), ramp((time - end) / 0.4))
    return time, level, away


@dataclass(frozen=True)
class Surface:
    """The specimen's surface on a fine square grid, y rising by rows, and its displacement by felupe."""

    rest: Floats  # (N, N, 3) mm
    moved: Floats  # (contacts, levels, N, N, 3) mm
    pulse: Floats  # (N, N, 3) mm

    @staticmethod
    def of(solved: Any, rng: np.random.Generator) -> Surface:
        """Felupe's result interpolated by cubic splines, with a relief of a tenth of a millimetre."""
        points = solved["at"]
        side = round(len(points) ** 0.5)
        x, y = points[:side, 0], points[::side, 1]
        fine = np.linspace(-_FIELD_MM / 2, _FIELD_MM / 2, _SIDE)

        def refine(values: Floats) -> Floats:
            parts = [RectBivariateSpline(y, x, values.reshape(side, side, 3)[..., k]) for k in range(3)]
            return np.stack([part(fine, fine) for part in parts], axis=-1)

        relief = gaussian_filter(rng.normal(size=(_SIDE, _SIDE)), 9)
        rest = np.stack([*np.meshgrid(fine, fine), 0.12 * relief / relief.std()], axis=-1)
        displacements = np.array([[refine(level) for level in contact] for contact in solved["moved"]])
        return Surface(rest, displacements, refine(solved["pulse"]))

    def at(self, levels: Floats, pulse: float) -> Floats:
        """Displacement (N, N, 3) mm at shares (contacts,) of the forces and a share of the pulse, by a cubic
        through felupe's load levels."""
        knots = np.linspace(0, 1, self.moved.shape[1] + 1)
        out = pulse * self.pulse
        for contact, level in zip(self.moved, levels, strict=True):
            if level > 0:
                out = out + KroghInterpolator(knots, [np.zeros_like(contact[0]), *contact])(level)
        return np.asarray(out, np.float64)


def _scene(
    surface: Surface,
    level: Floats,
    away: Floats,
    times: Floats,
    contacts: list[list[dict[str, Any]]],
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Renderer input: rest, motion (T, N, N, 3), tips (T, tools, 3), shafts (tools, 3), texture and bumps.

    `level`, `away`: of every frame, see `tool_motion`.
    """
    phase = rng.uniform(0, 2 * np.pi, 2)

    def pulse(time: float) -> float:
        angle = 2 * np.pi * time * np.array([_HEART_HZ, _BREATH_HZ]) + phase
        return float(np.array([0.7, 0.3]) @ np.sin(angle))

    displacements, tips = [], []
    shafts = _SHAFTS[-len(contacts[0]) :]
    for time, loads, distances in zip(times, level, away, strict=True):
        displacement = surface.at(loads, pulse(time) - pulse(0.0))
        k = int(np.argmin(distances))
        positions = np.array([tool["at_mm"] for tool in contacts[k]])
        column, row = np.rint((positions.T / _FIELD_MM + 0.5) * (_SIDE - 1)).astype(int)
        tips.append(surface.rest[row, column] + displacement[row, column] + _HOVER_MM * distances[k] * shafts)
        displacements.append(displacement.astype(np.float32))
    albedo, bumps = texture(rng)
    tools = {"tips": np.array(tips), "shafts": shafts}
    return {"rest": surface.rest, "moved": np.array(displacements), "albedo": albedo, "bumps": bumps} | tools


def texture(rng: np.random.Generator) -> tuple[Map, Map]:
    """Linear albedo (M, M, 3) of a pink ground with branching vessels, and bumps (M, M) of 0 to 1."""
    ground = np.zeros((_TEXELS, _TEXELS))
    for sigma in (3, 9, 27, 80):
        octave = gaussian_filter(rng.normal(size=ground.shape), sigma)
        ground += octave / octave.std() * sigma**0.3
    ground /= ground.std()
    shade = (1 + 0.05 * ground).astype(np.float32)[..., None]
    albedo: Map = np.array([0.62, 0.36, 0.30], np.float32) * shade
    bumps = gaussian_filter(ground, 2)
    for colour, number, width in (((0.30, 0.05, 0.06), 6, 16.0), ((0.45, 0.07, 0.05), 9, 9.0)):
        cover = np.zeros((_TEXELS, _TEXELS), np.uint8)
        for _ in range(number):
            _grow(cover, rng.uniform(0, _TEXELS, 2), rng.uniform(0, 2 * np.pi), width, rng)
        soft = gaussian_filter(cover.astype(np.float32) / 255, 1.2)[..., None]
        albedo = albedo * (1 - 0.85 * soft) + 0.85 * soft * np.array(colour, np.float32)
        bumps = bumps + 2 * gaussian_filter(soft[..., 0], 3)
    bumps -= bumps.min()
    return np.clip(albedo, 0, 1).astype(np.float32), (bumps / bumps.max()).astype(np.float32)


def _grow(cover: Pixels, start: Floats, heading: float, width: float, rng: np.random.Generator) -> None:
    """Draws a winding vessel that becomes thinner and branches."""
    tip = np.array(start, float)
    while width > 1.0 and (tip > -50).all() and (tip < _TEXELS + 50).all():
        heading += rng.normal(0, 0.18)
        next_tip = tip + 14 * np.array([np.cos(heading), np.sin(heading)])
        ends = [tuple(int(v) for v in point) for point in (tip, next_tip)]
        cv2.line(cover, ends[0], ends[1], 255, max(1, round(width)), cv2.LINE_AA)
        tip, width = next_tip, width * 0.992
        if rng.random() < 0.04:
            _grow(cover, tip, heading + rng.choice([-1, 1]) * rng.uniform(0.5, 1.1), 0.6 * width, rng)


def first_camera(rng: np.random.Generator) -> tuple[Floats, float]:
    """Blender's matrix of a camera above the centre, tilted up to 12 degrees, and its focal length [px]."""
    tilt, turn = np.deg2rad(rng.uniform(0, 12)), rng.uniform(0, 2 * np.pi)
    back = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    matrix = _aim_camera(_DISTANCE_MM * back, np.cross([0.0, 1.0, 0.0], back))
    return matrix, float(_SIZE[0] * _DISTANCE_MM / rng.uniform(31, 36))


def project_flow(rest: Floats, displacement: Floats, camera: Floats, focal_px: float) -> Map:
    """Flow (H, W, 2) px, in a camera's image of a surface (N, N, 3) at rest, of its motion (N, N, 3) mm."""

    def image(points: Floats) -> Floats:
        x, y, z = np.moveaxis((points.reshape(-1, 3) - camera[:3, 3]) @ camera[:3, :3], -1, 0)
        plane = np.stack([x, -y], axis=-1) / -z[:, None]
        return np.asarray(focal_px * plane + np.array(_SIZE) / 2 - 0.5)

    start = image(rest)
    pixels = np.stack(np.meshgrid(*map(np.arange, _SIZE)), axis=-1)
    shift = LinearNDInterpolator(Delaunay(start), image(rest + displacement) - start, fill_value=0.0)
    return np.asarray(shift(pixels), np.float32)


def right_camera(camera: Floats) -> Floats:
    """Blender's matrix of a second camera to the right of the first, directed at the same centre."""
    return _aim_camera(camera[:3, 3] + _BASE_MM * camera[:3, 0], camera[:3, 0])


def _aim_camera(position: Floats, right: Floats) -> Floats:
    """Matrix of a camera at a place [mm] directed at the centre, its x axis near the direction `right`."""
    back = position / np.linalg.norm(position)
    right = right - (right @ back) * back
    right = right / np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = position
    return matrix


def write_pair(file: Path, left: Floats, right: Floats, focal_px: float) -> None:
    """Writes the two cameras, matrices of Blender, as OpenCV's `stereoCalibrate` does: K, D, R, T [mm]."""
    # The optical axis is -z in Blender with y up, z in OpenCV with y down.
    first, second = (np.diag([1.0, -1.0, -1.0]) @ camera[:3, :3].T for camera in (left, right))
    K = np.array([[focal_px, 0, _SIZE[0] / 2 - 0.5], [0, focal_px, _SIZE[1] / 2 - 0.5], [0, 0, 1]])
    values = {"K1": K, "D1": np.zeros((1, 5)), "K2": K, "D2": np.zeros((1, 5))}
    values |= {"R": second @ first.T, "T": (second @ (left[:3, 3] - right[:3, 3]))[:, None]}
    recording_writer.write_storage(file, values)


def _read_with_noise(picture: Path, rng: np.random.Generator) -> Pixels:
    """The image with a sensor's noise."""
    rgb = read_picture(picture)[..., ::-1].astype(np.float32)
    noise = np.sqrt(0.6 + 0.012 * rgb) * rng.normal(size=rgb.shape)
    return np.asarray(np.clip(rgb + noise, 0, 255), np.uint8)


STUDY = Study(
    measure,
    "learn/foreign/*/pool.json",
    steps=("{work}/foreign {mechanics_python} {pictures_python}",),
    needs=("score", "score-stereo", "wide-tissue", "pulse"),
)
