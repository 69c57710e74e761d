"""The networks below the force, from nothing: segmentation, correction of flow and of depth.

    python -m weights make FOLDER

Every sequence, example and checkpoint is a file in a folder: an interrupted run continues. Cards state the
generator, the data, the seed and the hash of the weights that were used below.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from learn.training.threads import choose_device
from synth.dataset import provenance
from synth.errors import UserError
from synth.flow import correction, segmentation
from synth.flow.stereo import depth_correction
from synth.job import reader
from synth.sequence.simulation import simulate
from synth.system import checked_file
from weights import correction_training, segmentation_training
from weights.networks import export

_FIRST = {"randomized": 3000, "mission": 2000}  # of their sequences: others train forces
_BASELINES_MM = 24, 24, 24, 14, 34
_STORED = "rgb", "rgb_right", "tool", "tool_right", "glare", "flow", "visible", "motion", "shadow"


def make(
    folder: Path,
    randomized: int = 75,
    mission: int = 60,
    drawn: int = 600,
    steps: int = 29000,
    minutes: float = 40.0,
    seed: int = 0,
    device: str = "cpu",
    start: Path | None = None,
    pace: float = 1.0,
) -> None:
    """Renders sequences of two jobs, trains in turn, and writes weights and cards to `made` in the folder.

    They are not put next to the modules: whether they are better than those there is to be measured first.
    `drawn`: drawn pairs for the corrections; `steps`: of the segmentation, with 12 examples each, or 96 on
    the `device` "cuda"; `minutes`: CPU time of each correction. `start`: weights (ONNX) of a segmentation to
    train on from, `pace`: factor on its learning rate. What a folder has is made again only where settings or
    weights below differ.
    """
    device = choose_device(device).type
    counts = {"randomized": randomized, "mission": mission}
    files = {job: list(_render(job, count, folder / "sequences")) for job, count in counts.items()}
    sequences = [file for paths in files.values() for file in paths]
    generator = " ".join(sorted({str(np.load(file)["generator"]) for file in sequences}))
    common = {"seed": seed, "sequences": {job: len(paths) for job, paths in files.items()}}
    below: dict[str, str] = {}
    for part in (segmentation, correction, depth_correction):
        name = part.__name__.rpartition(".")[2]
        depth = part is depth_correction
        settings: dict[str, Any] = {"drawn": drawn, "minutes": minutes}
        if part is segmentation:
            settings = {"steps": steps, "device": device, "pace": pace}
            settings["start"] = None if start is None else _short_hash(start)
        card = {**common, **settings, "below": dict(below)}
        key = hashlib.sha256(json.dumps(card, sort_keys=True).encode()).hexdigest()[:12]
        onnx_file = folder / f"{name}-{key}.onnx"
        if not (onnx_file.exists() and onnx_file.with_suffix(".json").exists()):  # the card is written last
            net: torch.nn.Module
            if part is segmentation:
                frames = [dict(np.load(file)) for file in sequences]
                checkpoint = onnx_file.with_suffix(".ckpt")
                net, data = segmentation_training.train(frames, steps, seed, checkpoint, device, start, pace)
            else:
                examples = folder / f"examples-{key}"
                net, data = correction_training.train(examples, sequences, drawn, minutes, seed, depth=depth)
            export(net, onnx_file, card | data | {"generator": generator}, part.CHANNELS)
        weights = folder / "made" / f"{name}.onnx"
        weights.parent.mkdir(exist_ok=True)
        for suffix in (".onnx", ".json"):
            shutil.copy(onnx_file.with_suffix(suffix), weights.with_suffix(suffix))
        vars(part).update(WEIGHTS=onnx_file)  # the next part learns from what is recovered with these
        below[name] = _short_hash(weights)


def _short_hash(weights: Path) -> str:
    return hashlib.sha256(checked_file.read_bytes(weights, 2**22)).hexdigest()[:16]


def _render(job: str, count: int, folder: Path) -> Iterator[Path]:
    """Files of sequences of a job, those missing rendered; one that the job refuses is left out."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(_FIRST[job], _FIRST[job] + count):
        file, refused = folder / f"{job}-{index}.npz", folder / f"{job}-{index}.refused"
        if not file.exists() and not refused.exists():
            try:
                arrays = _render_arrays(job, index)
            except UserError as error:
                refused.write_text(str(error))
                continue
            np.savez_compressed(folder / "part.npz", allow_pickle=False, **arrays)
            (folder / "part.npz").rename(file)
            print(file.stem, flush=True)
        if file.exists():
            yield file


def _render_arrays(job: str, index: int) -> dict[str, Any]:
    """Pictures, masks and truth of both cameras, and their calibration."""
    baseline_mm = float(np.random.default_rng([55, index]).choice(_BASELINES_MM))
    keys = [f"render.stereo_mm={baseline_mm}", "store.extra=[shadow]", f"sequences={index + 1}"]
    scene = simulate(reader.load_job(job, keys), index)
    shots = list(scene.frames())
    arrays = {name: np.stack([getattr(shot, name) for shot in shots]) for name in _STORED}
    arrays |= {name: arrays[name].astype(np.float16) for name in ("flow", "motion")}
    arrays["shadow"] = np.rint(255 * np.clip(arrays["shadow"], 0, 1)).astype(np.uint8)
    size = np.linalg.norm(np.stack([shot.traction for shot in shots]), axis=-1)
    pressed = size > 0.05 * np.maximum(size.max((1, 2), keepdims=True), 1e-6)
    left, right = scene.view, scene.renderer.right
    assert right is not None
    lenses = {"K": left.K, "dist": left.distortion, "Kr": right.K, "distr": right.distortion}
    others = {"baseline": baseline_mm, "pressed": pressed, "tissue": scene.tissue}
    return arrays | lenses | others | {"generator": provenance.fingerprint()}
