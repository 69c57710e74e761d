"""`bench experiment foreign`: makes recordings with a force sensor that no code of ours has moved or drawn.

Mechanics by felupe (triquadratic bricks, compressible neo-Hookean, Hertz's pressure; a membrane as a net of
trusses; a pulse from the ground), pictures by Blender's Cycles, texture and tool of this module's own. What
is ours is the hand's course in time, the sensor and the folder's layout.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter

from bench.recording import writer
from evidence.measuring import measuring
from synth.errors import UserError
from synth.system.foreign_picture import read_picture

Floats = NDArray[np.float64]

KINDS = ("plain", "membrane", "pulse")
_HERE = Path(__file__).parent
_BLOCK_MM, _ELEMENTS, _LEVELS = (90.0, 50.0), (12, 7), 3
_FIELD_MM, _SIDE, _TEXELS = 46.0, 220, 1200
_DISTANCE_MM, _SENSOR_HZ = 300.0, 100.0
_STILL_S, _CONTACTS, _HOVER_MM = 2.0, 4, 45.0
_BASE_MM = 24.0
_FILMS = {"": "video.mp4", "right-": "right.mp4"}
"""What the pictures of either camera begin with, and its film."""
_BEAT_HZ, _BREATH_HZ = 1.2, 0.25


@dataclass(frozen=True)
class Hand:
    """What the hand does, on the sensor's clock."""

    time_s: Floats
    """(N,)"""
    level: Floats
    """(N, contacts) share of each contact's force."""
    away: Floats
    """(N, contacts) how far its tip is off, 0 to 1."""


@measuring("--out foreign --mechanics-python fem/bin/python --pictures-python bpy/bin/python")
def foreign(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder that gets the recordings.")],
    mechanics_python: Annotated[Path, typer.Option(help="A Python that has felupe and pypardiso.")],
    pictures_python: Annotated[Path, typer.Option(help="A Python that has bpy.")],
    kinds: Annotated[str, typer.Option(help="Comma-separated kinds of specimen.")] = ",".join(KINDS),
    count: Annotated[int, typer.Option(min=1, help="Of each kind.")] = 2,
    seconds: Annotated[float, typer.Option(min=8.0, help="Length of each.")] = 14.0,
    fps: Annotated[float, typer.Option(min=1.0, help="Frames a second.")] = 8.0,
    spp: Annotated[int, typer.Option(min=1, help="Light paths a pixel.")] = 24,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 500,
    eyes: Annotated[int, typer.Option(min=1, max=2, help="Cameras that look on.")] = 1,
) -> dict[str, Any]:
    """Makes recordings by felupe and Blender: plain, with a membrane, with a pulse."""
    wanted = [kind.strip() for kind in kinds.split(",")]
    if unknown := set(wanted) - set(KINDS):
        raise UserError(f"--kinds: {', '.join(sorted(unknown))}; there are {', '.join(KINDS)}")
    made = []
    for kind in wanted:
        for index in range(count):
            folder = out / f"{kind}-{index}"
            if not folder.exists():
                with writer.write_whole_folder(folder) as part:
                    rng = np.random.default_rng([seed, KINDS.index(kind), index])
                    film, pythons = (seconds, fps, spp, eyes), (mechanics_python, pictures_python)
                    _fill(part, folder.name, kind, rng, film, pythons)
            elif eyes == 2 and not (folder / "right.mp4").is_file():
                raise UserError(f"{folder}: is there already, of one eye")
            made.append(str(folder))
    return {"recordings": made}


def _fill(
    part: Path,
    name: str,
    kind: str,
    rng: np.random.Generator,
    film: tuple[float, float, int, int],
    pythons: tuple[Path, Path],
) -> None:
    seconds, fps, spp, eyes = film
    young = float(np.exp(rng.uniform(np.log(0.8), np.log(3.0))))
    contacts = [_contact(young, rng) for _ in range(_CONTACTS)]
    told = {
        "block_mm": _BLOCK_MM,
        "elements": _ELEMENTS,
        "levels": _LEVELS,
        "young_kpa": young,
        "poisson": float(rng.uniform(0.42, 0.48)),
        "membrane_mn_per_mm": float(rng.uniform(5, 40)) if kind == "membrane" else 0.0,
        "pulse_mm": float(rng.uniform(0.15, 0.4)) if kind == "pulse" else 0.0,
        "contacts": contacts,
    }
    with tempfile.TemporaryDirectory() as scratch:
        solved = _run(pythons[0], "felupe_worker.py", Path(scratch), "mechanics", told)
        surface = Surface.of(np.load(solved), rng)
        hand = course(seconds, rng)
        times = np.arange(0, seconds, 1 / fps)
        shown = _shown(surface, hand, times, contacts, told, rng)
        camera, focal = _camera(rng)
        size, cameras = (320, 240), dict(zip(_FILMS, (camera, beside(camera))[:eyes], strict=False))
        about = {
            "size": size,
            "focal_px": focal,
            "cameras": {eye: matrix.tolist() for eye, matrix in cameras.items()},
            "spp": spp,
            "threads": 1,
            "tool_mm": 0.6 * min(one["radius_mm"] for one in contacts),
            "lamps_mm": [[70.0, 40.0, 260.0], [-60.0, 20.0, 280.0]],
            "watts": 2.6e5,
        }
        _run(pythons[1], "cycles_worker.py", Path(scratch), "pictures", about, shown)
        noise = np.random.default_rng(rng.integers(2**31))
        for eye in cameras:
            pictures = (_recorded(Path(scratch) / f"{eye}{k:05d}.png", noise) for k in range(len(times)))
            writer.write_video(part / _FILMS[eye], pictures, times, crf=18)
    whole = sum(hand.level[:, [k]] * np.array(one["force_mn"]) for k, one in enumerate(contacts))
    to_camera = np.diag([1.0, -1.0, -1.0]) @ camera[:3, :3].T
    seen = np.asarray(whole) @ to_camera.T + 0.02 * rng.normal(size=(len(hand.time_s), 3))
    writer.write_force(part, hand.time_s, seen / 1000)
    pair: dict[str, Any] = {}
    if eyes == 2:
        write_pair(part / "pair.yaml", camera, cameras["right-"], focal, size)
        pair = {"stereo": {"calibration": "pair.yaml"}}
    writer.write_meta(
        part,
        pair
        | {
            "scale_mm_per_px": _DISTANCE_MM / focal,
            "young_kpa": young,
            "specimen": name,
            "sensor": {"axes": "camera", "acts_on": "tissue", "free_s": [[0.1, _STILL_S - 0.2]]},
            "sync": {"method": "clock"},
        },
    )


def _contact(young: float, rng: np.random.Generator) -> dict[str, Any]:
    """A press, a push aside or a pull at a place in the middle of the field; P = F/(E a²) of 0.06 to 0.25."""
    radius = float(rng.uniform(3, 5))
    size = float(rng.uniform(0.06, 0.25)) * young * radius**2
    lean, turn = np.deg2rad(rng.uniform(0, 55)), rng.uniform(0, 2 * np.pi)
    way = np.array([np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)])
    if rng.random() < 0.7:
        way[2] *= -1
    return {"at_mm": rng.uniform(-6, 6, 2).tolist(), "radius_mm": radius, "force_mn": (size * way).tolist()}


def course(seconds: float, rng: np.random.Generator) -> Hand:
    """One contact after the other, each with a rise, a hold and a fall; still at both ends."""
    time = np.arange(0, seconds, 1 / _SENSOR_HZ)
    level, away = np.zeros((len(time), _CONTACTS)), np.ones((len(time), _CONTACTS))
    slot = (seconds - 2 * _STILL_S) / _CONTACTS
    for k in range(_CONTACTS):
        start = _STILL_S + k * slot
        rise, fall = rng.uniform(0.25, 0.4) * slot, rng.uniform(0.2, 0.3) * slot
        end = start + 0.9 * slot
        level[:, k] = _ramp((time - start) / rise) * _ramp((end - time) / fall)
        level[:, k] *= rng.uniform(0.6, 1.0)
        away[:, k] = np.maximum(_ramp((start - time) / 0.4), _ramp((time - end) / 0.4))
    return Hand(time, level, away)


def _ramp(s: Floats) -> Floats:
    s = np.clip(s, 0, 1)
    return np.asarray(s * s * (3 - 2 * s), np.float64)


@dataclass(frozen=True)
class Surface:
    """The specimen's surface on a fine square grid, y rising by rows, and how felupe moved it."""

    rest: Floats
    """(N, N, 3) mm."""
    moved: Floats
    """(contacts, levels, N, N, 3) mm."""
    pulse: Floats
    """(N, N, 3) mm."""

    @staticmethod
    def of(solved: Any, rng: np.random.Generator) -> Surface:
        """Between felupe's nodes by cubic splines, with a relief of a tenth of a millimetre."""
        at = solved["at"]
        side = round(len(at) ** 0.5)
        x, y = at[:side, 0], at[::side, 1]
        fine = np.linspace(-_FIELD_MM / 2, _FIELD_MM / 2, _SIDE)

        def finer(values: Floats) -> Floats:
            parts = [RectBivariateSpline(y, x, values.reshape(side, side, 3)[..., k]) for k in range(3)]
            return np.stack([part(fine, fine) for part in parts], axis=-1)

        relief = gaussian_filter(rng.normal(size=(_SIDE, _SIDE)), 9)
        rest = np.stack([*np.meshgrid(fine, fine), 0.12 * relief / relief.std()], axis=-1)
        moved = np.array([[finer(level) for level in contact] for contact in solved["moved"]])
        return Surface(rest, moved, finer(solved["pulse"]))

    def at(self, levels: Floats, beat: float) -> Floats:
        """(N, N, 3) mm moved, at shares (contacts,) of the forces: between felupe's levels by a cubic through
        them, and with so much of the pulse."""
        known = np.linspace(0, 1, self.moved.shape[1] + 1)
        out = beat * self.pulse
        for contact, level in zip(self.moved, levels, strict=True):
            if level > 0:
                weights = [
                    np.prod([(level - known[j]) / (known[i] - known[j]) for j in range(len(known)) if j != i])
                    for i in range(1, len(known))
                ]
                out = out + np.tensordot(weights, contact, axes=1)
        return np.asarray(out, np.float64)


def _shown(
    surface: Surface,
    hand: Hand,
    times: Floats,
    contacts: list[dict[str, Any]],
    told: dict[str, Any],
    rng: np.random.Generator,
) -> dict[str, Any]:
    """What is drawn: rest, motion (T, N, N, 3), the tool's tip and shaft (T, 3), texture and bumps."""
    phase = rng.uniform(0, 2 * np.pi, 2)
    moved, tips, shafts = [], [], []
    for time in times:
        at = min(int(time * _SENSOR_HZ), len(hand.time_s) - 1)
        beat = 0.7 * np.sin(2 * np.pi * _BEAT_HZ * time + phase[0])
        beat += 0.3 * np.sin(2 * np.pi * _BREATH_HZ * time + phase[1])
        start = 0.7 * np.sin(phase[0]) + 0.3 * np.sin(phase[1])
        now = surface.at(hand.level[at], beat - start)
        k = int(np.argmin(hand.away[at]))
        here = np.array(contacts[k]["at_mm"])
        row, column = np.rint((here[::-1] / _FIELD_MM + 0.5) * (_SIDE - 1)).astype(int)
        shaft = np.array([0.5, -0.6, 1.0]) / np.linalg.norm([0.5, -0.6, 1.0])
        tips.append(surface.rest[row, column] + now[row, column] + _HOVER_MM * hand.away[at, k] * shaft)
        shafts.append(shaft)
        moved.append(now.astype(np.float32))
    albedo, bumps = texture(rng)
    return {
        "rest": surface.rest,
        "moved": np.array(moved),
        "tip": np.array(tips),
        "shaft": np.array(shafts),
        "albedo": albedo,
        "bumps": bumps,
    }


def texture(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Linear albedo (M, M, 3) of a pink ground with branching vessels, and bumps (M, M) of 0 to 1."""
    ground = np.zeros((_TEXELS, _TEXELS))
    for sigma in (3, 9, 27, 80):
        octave = gaussian_filter(rng.normal(size=ground.shape), sigma)
        ground += octave / octave.std() * sigma**0.3
    ground /= ground.std()
    shade = (1 + 0.05 * ground).astype(np.float32)[..., None]
    albedo: NDArray[np.float32] = np.array([0.62, 0.36, 0.30], np.float32) * shade
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


def _grow(
    cover: NDArray[np.uint8], start: Floats, heading: float, width: float, rng: np.random.Generator
) -> None:
    """Draws a vessel that wanders, thins and branches."""
    at = np.array(start, float)
    while width > 1.0 and (at > -50).all() and (at < _TEXELS + 50).all():
        heading += rng.normal(0, 0.18)
        after = at + 14 * np.array([np.cos(heading), np.sin(heading)])
        ends = [tuple(int(v) for v in point) for point in (at, after)]
        cv2.line(cover, ends[0], ends[1], 255, max(1, round(width)), cv2.LINE_AA)
        at, width = after, width * 0.992
        if rng.random() < 0.04:
            _grow(cover, at, heading + rng.choice([-1, 1]) * rng.uniform(0.5, 1.1), 0.6 * width, rng)


def _camera(rng: np.random.Generator) -> tuple[Floats, float]:
    """Blender's matrix of a camera above the middle, tilted up to 12 degrees, and its focal length [px]."""
    tilt, turn = np.deg2rad(rng.uniform(0, 12)), rng.uniform(0, 2 * np.pi)
    back = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = _DISTANCE_MM * back
    return matrix, float(320 * _DISTANCE_MM / rng.uniform(31, 36))


def beside(camera: Floats) -> Floats:
    """Blender's matrix of a second camera to the right of the first, turned to look at the same middle."""
    matrix = camera.copy()
    matrix[:3, 3] += _BASE_MM * camera[:3, 0]
    back = matrix[:3, 3] / np.linalg.norm(matrix[:3, 3])
    right = camera[:3, 0] - (camera[:3, 0] @ back) * back
    right /= np.linalg.norm(right)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    return matrix


def write_pair(file: Path, left: Floats, right: Floats, focal_px: float, size: tuple[int, int]) -> None:
    """Writes the two cameras, matrices of Blender, as OpenCV's `stereoCalibrate` would: K, D, R, T [mm]."""
    # Blender looks along -z with y up, OpenCV along z with y down.
    first, second = (np.diag([1.0, -1.0, -1.0]) @ one[:3, :3].T for one in (left, right))
    K = np.array([[focal_px, 0, size[0] / 2 - 0.5], [0, focal_px, size[1] / 2 - 0.5], [0, 0, 1]])
    told = {"K1": K, "D1": np.zeros((1, 5)), "K2": K, "D2": np.zeros((1, 5))}
    told |= {"R": second @ first.T, "T": (second @ (left[:3, 3] - right[:3, 3]))[:, None]}
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for name, value in told.items():
        storage.write(name, value)
    storage.release()


def _recorded(picture: Path, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture with a sensor's noise."""
    rgb = read_picture(picture)[..., ::-1].astype(np.float32)
    noise = np.sqrt(0.6 + 0.012 * rgb) * rng.normal(size=rgb.shape)
    return np.asarray(np.clip(rgb + noise, 0, 255), np.uint8)


def _run(
    python: Path,
    worker: str,
    folder: Path,
    name: str,
    told: dict[str, Any],
    given: dict[str, Any] | None = None,
) -> Path:
    """A worker in its own Python; gives back what it wrote. Raises UserError with what it said last."""
    (folder / f"{name}.json").write_text(json.dumps(told))
    if given is not None:
        np.savez(folder / f"{name}.npz", **given)
    done = subprocess.run([python, _HERE / worker, folder], capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "no word").splitlines()[-1]
        raise UserError(f"{python}: {worker}: {last}")
    return folder / f"{name}.npz"
