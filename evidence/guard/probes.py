"""Eleven small runs of the product, each returning arrays whose change would move stored results.

Flow, stereo and the scores read recordings that are stored beside this file, and the network reads fields of
closed form, so that a change upstream doesn't move what follows it: a probe that moves names the stage.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import binary_erosion

import synth
from bench.cli import app as bench_app
from bench.methods import posterior
from bench.methods.compliance import TissueKind
from bench.methods.method_interface import FrameMotion, MethodContext
from bench.methods.physics import Physics
from learn.data.clips import Clip, read_clip
from learn.data.grid import Grid
from learn.settings import preset
from learn.split import Split
from synth.arrays import Mask, Pixels
from synth.dataset.store import Dataset
from synth.fem import surface_embedding
from synth.flow import track
from synth.flow.segmentation import segment
from synth.flow.stereo import stereo_track as stereo_track
from synth.flow.stereo.calibration import read_rig
from synth.flow.stereo.stereo_track import Motion3D
from synth.sequence.fem_mechanics import build_volume

Arrays = dict[str, Any]
"""Name of an array -> its values."""

RECORDINGS = Path(__file__).with_name("recordings")
"""`mono` and `stereo`: recording folders of rendered sequences, made once by `store_recordings`."""

SEQUENCES = Path(__file__).with_name("sequences.zip")
"""Sequences of `tiny` without pictures; not the package's sample, which is rendered anew with the look."""

_SMALL = ["sequences=1", "frames=4", "anatomy.vertices=1500", "fem.tets=400", "render.size=[64,48]"]
_MECHANICS: dict[str, list[str]] = {
    "linear": ["fem.law=linear", "fem.load=[0.02,0.04]"],
    "co-rotational": ["fem.law=corotational", "fem.load=[0.05,0.1]"],
    "neo-hookean": ["fem.law=neo-hookean", "fem.load=[0.1,0.2]", "fem.poisson=[0.45,0.45]"],
    "membrane": ["fem.membrane.probability=1.0", "fem.load=[0.1,0.2]"],
    "pulse": ["fem.pulse.heart_mm=[0.2,0.2]", "fem.pulse.breath_mm=[0.3,0.3]", "fem.load=[0.1,0.2]"],
    "slip": ["fem.skull=slip", "fem.load=[0.1,0.2]"],
}
_PICTURES: dict[str, list[str]] = {
    "stereo": [
        "seed=3",
        "render.stereo_mm=24",
        "render.drift_mm=[0.8,0.8]",
        "render.scenery=[]",
        "store.extra=[shadow]",
        "fem.load=[0.1,0.3]",
    ],
    "randomized": ["seed=4", "randomize.texture=1", "randomize.surroundings=1", "randomize.light=1"],
}
_TRUTH = ("flow", "visible", "tool", "traction", "motion", "force")


@dataclass(frozen=True)
class Probe:
    """One probe and what may be read from its change."""

    run: Callable[[], Arrays]
    tolerance: float
    """Relative change of an array above which it has moved: below, another order of sums explains it."""
    versions: tuple[str, ...]
    """Integers of `synth.formats` of which one has to be raised when it moves, as caches depend on them."""
    packages: tuple[str, ...]
    """Packages of the product whose behaviour it covers."""


def probe_mesh() -> Arrays:
    """The volume's nodes and elements, the fine surface, and its embedding in the volume."""
    scene = synth.simulate(_load("tiny", *_SMALL, "seed=1"))
    volume = build_volume(scene)
    embedding = surface_embedding.embed(volume, scene.surface.vertices)
    smooth = np.sin(volume.points / 7.0)
    return {
        "nodes": volume.points,
        "elements": volume.cells,
        "surface": scene.surface.vertices,
        "faces": scene.surface.faces,
        "embedded": embedding.move(smooth),
    }


def probe_mechanics() -> Arrays:
    """Motion, traction and energy under three laws, a membrane, a pulse, and slip at the skull."""
    arrays: Arrays = {}
    for name, keys in _MECHANICS.items():
        motion = synth.simulate(_load("tiny", *_SMALL, "seed=2", *keys)).motion
        arrays[f"{name}: displacement"] = motion.displacement
        arrays[f"{name}: traction"] = motion.traction
        arrays[f"{name}: tips"] = motion.tip[0]
        arrays[f"{name}: motion of the tips"] = motion.tip - motion.tip[0]
        if motion.energy is not None:
            arrays[f"{name}: energy"] = motion.energy
    return arrays


def probe_picture() -> Arrays:
    """Pictures of both cameras, depth, highlights and shadows, of a usual and of a randomised scene."""
    arrays: Arrays = {}
    for name, keys in _PICTURES.items():
        _, frames = _scene(keys)
        arrays[f"{name}: left"] = np.stack([frame.rgb for frame in frames])
        depth = np.stack([frame.depth for frame in frames])
        arrays[f"{name}: depth"] = np.where(np.isfinite(depth), depth, 0.0)
        arrays[f"{name}: highlights"] = np.stack([frame.glare for frame in frames])
        if frames[0].shadow is not None:
            arrays[f"{name}: shadows"] = np.stack([np.asarray(frame.shadow) for frame in frames])
        if frames[0].rgb_right is not None:
            arrays[f"{name}: right"] = np.stack([np.asarray(frame.rgb_right) for frame in frames])
    return arrays


def probe_truth() -> Arrays:
    """Labels of geometry and force on the pixels of a scene with two cameras, and the poses of the camera."""
    scene, frames = _scene(_PICTURES["stereo"])
    arrays: Arrays = {}
    for name in _TRUTH:
        values = np.stack([getattr(frame, name) for frame in frames]).astype(np.float64)
        # No value where a ray meets nothing; how many there are is part of `visible` itself.
        arrays[name] = np.where(np.isfinite(values), values, -1.0)
    # The tissue's alone: what lies around it is part of the look. The relief, not the camera's distance.
    inside = binary_erosion(scene.tissue, iterations=3)
    depth = np.stack([frame.depth for frame in frames]).astype(np.float64)[:, inside]
    arrays["depth of the tissue"] = depth - depth.max()
    poses = np.stack([frame.camera.pose for frame in frames])
    arrays["camera"], arrays["motion of the camera"] = poses[0], poses - poses[0]
    return arrays


def probe_flow() -> Arrays:
    """Masks and recovered flow of a stored recording, whose motion is below 2 px, and flow of up to 15 px."""
    left, blocked, tissue = _read_pictures("stereo", "frames")
    track = synth.recover_flow(left, blocked, tissue)
    large_track = synth.recover_flow(*_pull_picture(left[0]), np.ones_like(tissue))
    segmentations = [segment(left[0], picture) for picture in left]
    return {
        "flow": track.flow,
        "confidence": track.confidence,
        "large flow": large_track.flow,
        "confidence of large flow": large_track.confidence,
        "instrument": np.stack([segmentation.instrument for segmentation in segmentations]),
        "highlight": np.stack([segmentation.highlight for segmentation in segmentations]),
    }


def probe_lost_flow() -> Arrays:
    """Flow of a picture pulled by 5 px, from a flow that is wrong by 20 px in a strip at its border."""
    left, _, tissue = _read_pictures("stereo", "frames")
    pictures, bars = _pull_picture(left[0])
    tracker = track.Tracker("tvl1", pictures[0], bars[0], np.ones_like(tissue))
    tracker.initial = np.zeros((*tissue.shape, 2), np.float32)
    tracker.initial[:, :24, 0] = 20.0
    flow, confidence = tracker.step(pictures[1], bars[1])
    return {"flow": flow, "confidence": confidence}


def probe_stereo() -> Arrays:
    """Motion in three dimensions of a stored recording, given a flow of closed form."""
    left, blocked, tissue = _read_pictures("stereo", "frames")
    right, unseen, _ = _read_pictures("stereo", "right")
    height, width = tissue.shape
    rig = read_rig(RECORDINGS / "stereo/stereo.yaml", (width, height))
    tracker = stereo_track.StereoTracker(rig, left[:1], right[:1], blocked[0], unseen[0], tissue)
    y, x = np.mgrid[:height, :width] / height
    shape = np.stack([np.sin(3 * x) * np.cos(2 * y), np.cos(2 * x + y)], axis=-1).astype(np.float32)
    frames = [
        tracker.step(
            left[t],
            right[t],
            blocked[t],
            unseen[t],
            np.float32(0.2 * t) * shape,
            0.9 * tissue.astype(np.float32),
        )
        for t in range(1, len(left))
    ]
    return {
        "motion": np.stack([frame.motion for frame in frames]),
        "deviation": np.stack([frame.deviation for frame in frames]),
        "disparity": tracker.rest.disparity,
    }


def probe_network() -> Arrays:
    """Losses of four epochs by two loss functions, and the networks' answers, on clips of closed form.

    Also what stored sequences are on a network's grid.
    """
    from learn.training.train import train  # PyTorch is loaded by training alone

    clips = [_clip(k) for k in range(6)]
    split = Split(fit=(0, 1, 2, 3), select=(4,), test=(5,))
    arrays: Arrays = {}
    for loss in ("antighost", "off-target"):
        settings = preset("tiny", size=16, loss=loss, epochs=4, batch=4, extent_mm=36.0)
        settings = settings.model_copy(
            update={"arch": settings.arch.model_copy(update={"width": 4, "levels": 2})}
        )
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "model"
            train(clips, split, settings, out)
            history = [json.loads(line) for line in (out / "history.jsonl").read_text("utf-8").splitlines()]
            arrays[f"{loss}: losses"] = [epoch["loss"] for epoch in history]
            arrays[f"{loss}: answer"] = _answer(out)
    with tempfile.TemporaryDirectory() as folder:
        shutil.unpack_archive(SEQUENCES, folder)
        for k, sequence in enumerate(Dataset(Path(folder))):
            clip = read_clip(sequence, Grid(32), ("ideal", "recovered"))
            arrays[f"grid {k}: density"] = clip.density
            arrays |= {
                f"grid {k}: {source}": displacement for source, displacement in clip.displacement.items()
            }
    return arrays


def probe_compliance() -> Arrays:
    """The reduced compliance of a covered tissue, for two components of motion."""
    with tempfile.TemporaryDirectory() as folder, _environment(SULCUS_CACHE=folder):
        basis = posterior.load_basis(2, TissueKind(edge="bonded", membrane=15.0, poisson=0.45, stretch=1.02))
    directions = basis.motion[:, : len(basis.size)]
    spread = directions * basis.size
    # The sign of a direction is arbitrary; covariance of motion, and force by motion, don't depend on it.
    return {"covariance": spread @ spread.T, "force": basis.force @ directions.T}


def probe_score() -> Arrays:
    """The score of a stored recording with one camera of which scale and stiffness are stated, by physics."""
    return _score("mono")


def probe_score_stereo() -> Arrays:
    """The score of a stored recording with two cameras, by physics and the pretrained network."""
    return _score("stereo", "--model", "stereo")


def probe_wide_tissue() -> Arrays:
    """Forces by physics, with two cameras and with one, of two dents in tissue wider than an opening."""
    scale, rows, columns = 0.5, 80, 120  # mm per pixel
    y, x = (np.mgrid[:rows, :columns] - np.array([rows - 1, columns - 1])[:, None, None] / 2) * scale
    size_mm = np.zeros((rows, columns))
    for place, depth_mm in (((14.0, -5.0), 1.6), ((2.0, 3.0), 0.6)):
        size_mm += depth_mm * np.exp(-(np.square(x - place[0]) + np.square(y - place[1])) / 18)
    shape = np.stack([0.4 * size_mm, 0.2 * size_mm, size_mm], axis=-1).astype(np.float32)
    arrays: Arrays = {}
    with tempfile.TemporaryDirectory() as folder, _environment(SULCUS_CACHE=folder):
        for cameras in (2, 1):
            method = Physics()
            scene = MethodContext(np.ones((rows, columns), bool), scale, 5.0, "stripped", (0.45, 0.45), False)
            for second, level in enumerate((0, 0.5, 1)):
                moved = np.float32(level) * shape
                seen = Motion3D(moved, np.full_like(moved, 0.01)) if cameras == 2 else None
                sure = np.ones((rows, columns), np.float32)
                method(FrameMotion(moved[..., :2] / scale, sure, motion=seen, time_s=second), scene, False)
            estimates = method.revise(np.zeros(3, bool))
            arrays[f"force, cameras {cameras}"] = [estimate.force_mn for estimate in estimates]
            arrays[f"map, cameras {cameras}"] = method.map_forces()
    return arrays


def probe_pulse() -> Arrays:
    """Forces by physics, with two cameras, of small and large dents in pulsating tissue, with a span without
    contact and with none."""
    scale, side = 0.3, 80  # mm per pixel
    y, x = (np.mgrid[:side, :side] - (side - 1) / 2) * scale
    tissue, radius = np.hypot(x, y) < 11.5, np.hypot(x, y) / 12
    depth_mm = np.exp(-(np.square(x - 2) + np.square(y + 1)) / 40)
    dent = np.stack([0.4 * depth_mm, 0.2 * depth_mm, depth_mm], axis=-1)
    rise = np.stack([0.1 * x / 12, 0.05 * y / 12, 0.3 * radius**2 - 0.3], axis=-1)
    seconds = np.arange(9)
    phases, loads = 0.5 - 0.5 * np.cos(0.44 * np.pi * seconds), np.clip(seconds - 5, 0, None) / 3
    arrays: Arrays = {}
    with tempfile.TemporaryDirectory() as folder, _environment(SULCUS_CACHE=folder):
        for most_mm, free in product((0.4, 2.5), (6, 0)):
            method, sure = Physics(), np.ones((side, side), np.float32)
            scene = MethodContext(tissue, scale, 5.0, "stripped", (0.45, 0.45), True)
            for second, phase, load in zip(seconds, phases, loads, strict=True):
                moved = (phase * rise + most_mm * load * dent).astype(np.float32)
                seen = Motion3D(moved, np.full_like(moved, 0.01))
                frame = FrameMotion(moved[..., :2] / scale, sure, motion=seen, time_s=float(second))
                method(frame, scene, False)
            estimates = method.revise(seconds < free)
            arrays[f"force, {most_mm:g} mm, {free} free"] = [estimate.force_mn for estimate in estimates]
    return arrays


PROBES: Mapping[str, Probe] = {
    "mesh": Probe(probe_mesh, 1e-4, ("MESH",), ("synth/fem/mesh", "synth/geometry", "synth/render/anatomy")),
    "mechanics": Probe(probe_mechanics, 1e-4, ("CONTENT",), ("synth/fem", "synth/sequence", "synth/job")),
    "picture": Probe(probe_picture, 1e-3, ("CONTENT",), ("synth/render", "synth/sequence", "synth/job")),
    "truth": Probe(probe_truth, 1e-3, ("CONTENT",), ("synth/render", "synth/sequence", "synth/job")),
    "flow": Probe(probe_flow, 1e-2, ("MOTION",), ("synth/flow",)),
    "lost-flow": Probe(probe_lost_flow, 1e-2, ("MOTION",), ("synth/flow",)),
    "stereo": Probe(probe_stereo, 1e-2, ("MOTION",), ("synth/flow/stereo",)),
    "network": Probe(probe_network, 1e-2, ("TRAINING", "CLIPS"), ("learn", "synth/flow/onnx_network")),
    "compliance": Probe(probe_compliance, 1e-3, ("COMPLIANCE", "MESH"), ("bench/methods",)),
    "score": Probe(
        probe_score,
        3e-2,
        ("SCORING", "COMPLIANCE", "MOTION"),
        ("bench", "synth/flow/recording", "synth/video", "learn/inference"),
    ),
    "score-stereo": Probe(
        probe_score_stereo,
        3e-2,
        ("SCORING", "COMPLIANCE", "MOTION"),
        ("bench", "synth/flow/recording", "synth/video", "learn/inference"),
    ),
    "wide-tissue": Probe(probe_wide_tissue, 3e-2, ("SCORING", "COMPLIANCE"), ("bench/methods",)),
    "pulse": Probe(probe_pulse, 3e-2, ("SCORING", "COMPLIANCE"), ("bench/methods",)),
}
"""By name; the order is that of the pipeline."""


def store_recordings() -> None:
    """Renders the recordings that probes read. They are input: only another kind needs new ones."""
    from bench.recording.from_sequence import export_recording

    size = ["sequences=1", "render.size=[128,96]", "anatomy.vertices=4000", "fem.tets=800"]
    jobs = {
        "mono": [*size, "seed=5", "frames=8", "fps=8"],
        "stereo": [*size, "seed=3", "frames=6", "fps=6", "render.stereo_mm=24", *_MECHANICS["pulse"][:2]],
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, keys in jobs.items():
            job = synth.load_job("tiny", [*keys, "fem.load=[0.1,0.3]"])
            with synth.open_dataset(Path(folder) / name, job) as root:
                path = synth.write_scene(synth.simulate(job), root)
            export_recording(synth.open_sequence(path), RECORDINGS / name)


def _load(name: str, *keys: str) -> synth.Job:
    return synth.load_job(name, [*keys])


def _scene(keys: Sequence[str]) -> tuple[synth.Scene, list[synth.Frame]]:
    scene = synth.simulate(_load("tiny", *_SMALL, *keys))
    return scene, [scene.frame(t) for t in range(len(scene))]


def _read_pictures(name: str, folder: str) -> tuple[Pixels, Mask, Mask]:
    """Pictures (T, H, W, 3), instruments (T, H, W) of the left camera and tissue (H, W) of a recording."""
    home = RECORDINGS / name
    files = sorted((home / folder).glob("*.png"))
    pictures = np.stack([_read(file) for file in files])
    masks = np.zeros(pictures.shape[:3], bool)
    for file in (home / "masks").glob("*.png") if folder == "frames" else ():
        masks[int(file.stem)] = _read(file)[..., 0] > 0
    return pictures, masks, _read(home / "tissue.png")[..., 0] > 0


def _pull_picture(rest: Pixels) -> tuple[Pixels, Mask]:
    """A picture (H, W, 3) pulled by 0 to 15 px under a bar, in four frames, and the bar (4, H, W)."""
    height, width = rest.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    middle = width / 2, height / 2
    reach = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (0.08 * height**2))
    pictures, bars = [], []
    for px in (0, 5, 10, 15):
        along, down = 0.8 * px, 0.6 * px
        picture = cv2.remap(rest, x - along * reach, y - down * reach, cv2.INTER_CUBIC)
        bar = (np.abs(x - middle[0] - along) < 0.05 * width) & (y < middle[1] + down) & (px > 0)
        picture[bar] = (150, 155, 160)
        pictures.append(picture)
        bars.append(bar)
    return np.stack(pictures), np.stack(bars)


def _read(file: Path) -> Pixels:
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)
    if picture is None:
        raise FileNotFoundError(file)
    return np.asarray(picture, np.uint8)


def _clip(number: int) -> Clip:
    """Displacement and force of closed form on 16 × 16 cells: a push, of another size for each number."""
    size, frames, pitch = 16, 4, 36.0 / 16
    y, x = np.mgrid[:size, :size] + 0.5 - size / 2
    place = 3.0 * np.array([np.cos(1.7 * number), np.sin(2.3 * number)])
    bump = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (4.0 + number))
    load = np.linspace(0.0, 1.0, frames)[:, None, None]
    toward = np.stack([x - place[0], y - place[1]]) * bump / 8
    displacement = (load[:, None] * toward * (0.2 + 0.05 * number)).astype(np.float32)
    pressing = np.array([0.2, -0.1, 0.9])[:, None, None] * bump
    density = (load[:, None] * pressing).astype(np.float32)
    mask = (np.hypot(x, y) < 7).astype(np.float32)
    density *= mask
    return Clip(
        name=f"{number:06d}",
        content_hash=f"{number:032x}",
        group=f"anatomy {number}",
        young_kpa=1.0 + 0.2 * number,
        mask=mask,
        displacement={"ideal": displacement},
        confidence=np.ones((frames, size, size), np.float32),
        density=density,
        force=density.sum((2, 3), dtype=np.float64) * pitch**2 * (1.0 + 0.2 * number),
    )


def _answer(model: Path) -> Any:
    """Answer (1, C, 16, 16) to a ramp, in every channel."""
    import torch

    from learn import checkpoint

    network, _ = checkpoint.read_model(model)
    channels = next(network.parameters()).shape[1]
    ramp = torch.linspace(-1, 1, 16 * 16).reshape(1, 1, 16, 16)
    with torch.no_grad():
        return network(ramp.repeat(1, channels, 1, 1)).numpy()


def _score(name: str, *options: str) -> Arrays:
    """Forces by every method of `bench score`, and their errors, with nothing from the user's cache."""
    from typer.testing import CliRunner

    with tempfile.TemporaryDirectory() as folder, _environment(SULCUS_CACHE=folder):
        result = CliRunner().invoke(
            bench_app, ["score", str(RECORDINGS / name), *options, "-o", f"{folder}/out"]
        )
        if result.exit_code:
            raise RuntimeError(f"bench score {name}: {result.output} {result.exception!r}")
        score = json.loads(Path(folder, "out/score.json").read_text("utf-8"))
    curve = score["curve"]
    arrays: Arrays = {f"force, {method}": force for method, force in curve["predicted_mn"].items()}
    arrays["sensor"] = curve["sensor_mn"]
    arrays["errors"] = [method["scores"]["mae_mn"] for method in score["methods"].values()]
    return arrays


@contextmanager
def _environment(**values: str) -> Any:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
