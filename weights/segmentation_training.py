"""Trains the segmentation on domain-randomised renders, and on objects drawn over these and photographs."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from evidence.flow.scenes import jpeg, noise_field, photographs_of
from synth.arrays import Map, Pixels
from synth.flow.segmentation import CLASSES
from synth.system import resources
from weights import paste
from weights.correction_training import draw_motion, draw_texture
from weights.networks import SegmentationNet, follow, read_onnx

_SIZE = 224, 160  # px of examples, width and height
_PHOTOGRAPH = 384  # px, side of photographs
_RATE = 4e-3
_PACE = {"cpu": (4, 12, 48), "cuda": (6, 96, 20_000)}  # examples that a step draws, learns, and chooses from
_PASTED, _PLAIN, _REST = 0.65, 0.45, 0.4  # chances: of drawn objects, of no render, of objects at rest
_MARKED = 0.5  # chance that tissue that is no moving render has lines or patches that look like objects
_VESSELS, _STILL = 0.6, 0.35  # the same of thick vessels; and that this tissue is a rest frame of a render
_FAR = 0.3  # weight of what is neither tissue nor instrument
_SHADED = 0.5  # share of the light taken at which a pixel is all shadow
Example = tuple[Pixels, Pixels, Map, Map]  # frame, rest (H, W, 3) uint8; classes, weights (H, W, 3)


def example(sequences: Sequence[Any], photographs: Sequence[Map], rng: np.random.Generator) -> Example:
    """A frame, its rest frame, and the classes to be found."""
    if rng.random() < _PLAIN:
        rest, now, weight = _draw_warped(sequences, photographs, rng)
    else:
        rest, now, weight = _draw_rendered(sequences[int(rng.integers(len(sequences)))], rng)
    if rng.random() < _PASTED or (now.instrument.max() == 0 and rng.random() < 0.5):
        other = _square(photographs, rng)
        for _ in range(int(rng.choice([1, 1, 2, 3]))):
            draw = paste.draw_object if rng.random() < 0.25 else paste.draw_instrument
            sprite = draw(rng, now.picture, other)
            now = paste.paste(now, sprite, np.zeros(2))
            if rng.random() < _REST:
                rest = paste.paste(rest, sprite, rng.normal(0, 0.15, 2) * (rng.random() < 0.7))
    if rng.random() < 0.3:
        seed, seed_step = rng.integers(2**31), int(rng.random() < 0.5)  # often highlights stay
        layers = (now, seed_step), (rest, 0)
        now, rest = (paste.add_highlights(a, np.random.default_rng(seed + b)) for a, b in layers)
    classes = np.stack([getattr(now, name) for name in CLASSES], -1)
    classes[..., 1] = np.clip(classes[..., 1] / _SHADED, 0, 1)
    return *_develop(now.picture, rest.picture, rng), classes, weight


def _draw_rendered(sequence: Any, rng: np.random.Generator) -> tuple[Any, Any, Map]:
    """Layers of rest and a later frame of a sequence, by a random camera, turned and cut; and weights."""
    right = "_right" * bool(rng.random() < 0.5 and "rgb_right" in sequence)
    t = int(rng.integers(len(sequence["rgb"])))
    start = 0 if rng.random() < 0.8 else int(rng.integers(len(sequence["rgb"])))
    tool, nothing = sequence["tool" + right][t], np.zeros(sequence["tissue"].shape, np.float32)
    is_shadow_known = not right and "shadow" in sequence
    shadow = sequence["shadow"][t] / np.float32(255) if is_shadow_known else nothing
    glare = nothing if right else sequence["glare"][t].astype(np.float32)
    # The right picture's tissue is not stored: that of the left is near enough for a weight.
    tissue_weight = np.where(sequence["tissue"] | tool, 1.0, _FAR).astype(np.float32)
    planes = [
        sequence["rgb" + right][t],
        sequence["rgb" + right][start],
        np.dstack([tool, shadow, glare, tissue_weight]),
    ]
    turn = _turn(sequence["tissue"].shape, rng)
    mode = {"flags": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REFLECT_101}
    now, rest, flat = (cv2.warpAffine(np.asarray(p, np.float32), turn, _SIZE, **mode) for p in planes)
    weight = np.repeat(flat[..., 3:], len(CLASSES), -1)
    weight[..., 1] *= is_shadow_known
    weight[..., 2] *= not right
    layer = paste.Layer(now, flat[..., 0], flat[..., 1], flat[..., 2])
    return paste.Layer.of(rest), layer, weight


def _turn(shape: tuple[int, ...], rng: np.random.Generator) -> Map:
    """A random similarity (2, 3), perhaps mirrored, from a picture's middle to that of `_SIZE`."""
    height, width = shape
    zoom = _SIZE[0] / width * np.exp(rng.uniform(np.log(0.8), np.log(1.7)))
    turn = rng.choice([0, 0.5, 1, 1.5]) * np.pi + rng.normal(0, 0.3)
    matrix = zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    matrix[:, 0] *= rng.choice([-1, 1])
    middle = np.array([width, height]) / 2 + rng.uniform(-0.15, 0.15, 2) * width
    return np.column_stack([matrix, np.array(_SIZE) / 2 - matrix @ middle])


def _draw_warped(
    sequences: Sequence[Any], photographs: Sequence[Map], rng: np.random.Generator
) -> tuple[Any, Any, Map]:
    """A picture as tissue, with what looks like objects but is tissue, at rest and moved; and weights."""
    picture, is_render = _still(sequences, photographs, rng)
    rest_layer = paste.Layer.of(picture)
    if rng.random() < _MARKED:
        for _ in range(int(rng.integers(1, 4))):
            sprite = paste.draw_marking(rng, rest_layer.picture, _square(photographs, rng))
            rest_layer = paste.Layer.of(paste.paste(rest_layer, sprite, np.zeros(2)).picture)
    if rng.random() < _VESSELS:
        rest_layer = paste.add_vessels(rest_layer, rng)
    size = max(_SIZE)
    flow = cv2.resize(draw_motion(size // 2, rng), _SIZE) * np.float32(2) * (rng.random() < 0.8)
    y, x = np.mgrid[: _SIZE[1], : _SIZE[0]].astype(np.float32)
    x, y = x - flow[..., 0], y - flow[..., 1]
    moved_picture, highlight = (
        cv2.remap(plane, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        for plane in (rest_layer.picture, rest_layer.highlight)
    )
    weight = np.ones((*_SIZE[::-1], len(CLASSES)), np.float32)
    weight[..., 2] *= not is_render  # its own highlights move otherwise
    return rest_layer, replace(rest_layer, picture=moved_picture, highlight=np.clip(highlight, 0, 1)), weight


def _still(
    sequences: Sequence[Any], photographs: Sequence[Map], rng: np.random.Generator
) -> tuple[Map, bool]:
    """A photograph, drawn texture or rest frame without instruments, and whether it is the last of these."""
    photograph, kind = _square(photographs, rng), rng.random()
    if kind < 0.5 * (1 - _STILL):
        return cv2.resize(draw_texture(_SIZE[0], rng), _SIZE, interpolation=cv2.INTER_AREA), False
    if kind > 1 - _STILL:
        sequence = sequences[int(rng.integers(len(sequences)))]
        if not sequence["tool"][0].any():
            rest = np.asarray(sequence["rgb"][0], np.float32)
            turn = _turn(rest.shape[:2], rng)
            return cv2.warpAffine(rest, turn, _SIZE, borderMode=cv2.BORDER_REFLECT_101), True
    return photograph, False


def _square(photographs: Sequence[Map], rng: np.random.Generator) -> Map:
    """A part of one of the photographs (N, N, 3), turned, as large as an example, with random colours."""
    photograph = photographs[int(rng.integers(len(photographs)))]
    turn = _turn(photograph.shape[:2], rng)
    part = cv2.warpAffine(photograph, turn, _SIZE, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    mix = np.eye(3) + rng.normal(0, 0.25, (3, 3))
    return np.asarray(np.clip(part @ mix.T * rng.uniform(0.5, 1.2), 0, 255), np.float32)


def _develop(now: Map, rest: Map, rng: np.random.Generator) -> list[Any]:
    """Both pictures by one camera whose light changes a little."""
    gain, gamma, white = rng.uniform(0.6, 1.3), np.exp(rng.normal(0, 0.2)), np.exp(rng.normal(0, 0.12, 3))
    blur, noise = rng.choice([0, 0, 0.6, 1.2]), rng.choice([0.3, 1, 2, 5])
    quality = int(rng.choice([0, 0, 90, 70, 45]))
    grey, drift = rng.random() < 0.08, rng.random() < 0.3
    coarse = 1.0 if rng.random() < 0.7 else rng.uniform(1, 3)
    pictures = []
    for k, picture in enumerate((now, rest)):
        light: Any = np.float32(gain)
        if drift and k == 0:
            uneven = rng.uniform(0, 0.15) * noise_field(_SIZE[::-1], 250, rng)
            light = light * (1 + uneven[..., None] + np.float32(rng.normal(0, 0.05)))
        if coarse > 1:
            size = round(_SIZE[0] / coarse), round(_SIZE[1] / coarse)
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            light = light if np.ndim(light) == 0 else cv2.resize(light, size)[..., None]
        level = np.clip(picture / np.float32(255), 0, 1.1) ** np.float32(gamma)
        level = 255 * np.clip(light * np.float32(white) * level, 0, 1)
        if blur:
            level = cv2.GaussianBlur(level, (0, 0), float(blur))
        if grey:
            level = np.repeat(level.mean(-1, keepdims=True), 3, -1)
        level += np.float32(noise) * rng.standard_normal(level.shape, np.float32)
        encoded = jpeg(np.clip(level, 0, 255).astype(np.uint8), quality)
        pictures.append(encoded if coarse == 1 else cv2.resize(encoded, _SIZE, interpolation=cv2.INTER_CUBIC))
    return pictures


@dataclass(frozen=True, eq=False)
class _DrawnExamples(Dataset[Any]):
    """New examples by their number, the same whenever they are drawn."""

    sequences: Sequence[Any]
    photographs: Sequence[Map]
    seed: int
    new: int
    numbers: range

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, k: int) -> Tensor:
        rng = np.random.default_rng([self.seed, self.numbers[k]])
        examples = [example(self.sequences, self.photographs, rng) for _ in range(self.new)]
        return torch.stack([pack(entry) for entry in examples])


def pack(entry: Example) -> Tensor:
    """Planes (12, H, W) uint8 of an example: frame, rest frame, classes and weights."""
    planes = *entry[:2], *(np.rint(255 * plane).astype(np.uint8) for plane in entry[2:])
    return torch.from_numpy(np.concatenate(planes, -1)).permute(2, 0, 1).contiguous()


def batch(examples: Tensor, rng: np.random.Generator) -> tuple[Tensor, ...]:
    """Network input (B, 6, H, W), classes and weights (B, 3, H, W) of 0..1 of packed examples (B, 12, H, W).

    They are mirrored and their colours are exchanged, alike in groups of four to save calls.
    """
    parts = []
    for chunk in torch.split(examples, 4):
        axes = [axis for axis in (-2, -1) if rng.random() < 0.5]
        order = rng.permutation(3)
        planes = torch.as_tensor(np.concatenate([order, 3 + order, np.arange(6, 12)]), device=chunk.device)
        parts.append(chunk[:, planes].flip(axes))
    augmented = torch.cat(parts)
    classes, weights = augmented[:, 6:9].float() / 255, augmented[:, 9:].float() / 255
    frames = augmented[:, :6].float().reshape(-1, 2, 3, *_SIZE[::-1])
    deviation, mean = torch.std_mean(frames, (2, 3, 4), correction=0, keepdim=True)
    return ((frames - mean) / (deviation + 8.0)).flatten(1, 2), classes, weights  # as `segmentation.prepare`


def train(
    sequences: Sequence[Any],
    steps: int,
    seed: int,
    checkpoint: Path,
    device: str = "cpu",
    start: Path | None = None,
    pace: float = 1.0,
) -> tuple[SegmentationNet, dict[str, Any]]:
    """A network trained for some steps, and its data in numbers; it continues from a checkpoint.

    `device`: cpu, or cuda, which learns eight times as many examples in a step, with 9 GB of GPU memory.
    `start`: weights (ONNX) to start from instead of random ones; `pace`: factor on the learning rate.
    """
    cv2.setNumThreads(0)  # its threads would not survive the fork of the processes that draw
    torch.manual_seed(seed)
    new, count, latest = _PACE[device]
    workers = 1 if device == "cpu" else max(1, resources.cores() - 1)
    net = SegmentationNet().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    if start is not None:
        read_onnx(net, start)
    average, rate = copy.deepcopy(net), pace * _RATE
    optimiser = torch.optim.AdamW(net.parameters(), rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps, pct_start=0.1)
    parts: dict[str, Any] = {"net": net, "average": average, "optimiser": optimiser, "schedule": schedule}
    first_step, recent, start_s = 0, deque[Tensor](maxlen=100), time.time()
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=False)
        first_step = state["step"]
        for name, part in parts.items():
            part.load_state_dict(state[name])
    ahead = -(-4 * count // new)  # the first step has some choice
    numbers = range(max(0, first_step + ahead - latest // new - 1), steps + ahead)
    source = _DrawnExamples(sequences, photographs_of("tuning", _PHOTOGRAPH), seed, new, numbers)
    pool = torch.empty(latest, 12, *_SIZE[::-1], dtype=torch.uint8, device=device)
    net.train()
    # All processes share the memory of the sequences.
    loader = DataLoader(source, None, num_workers=workers, multiprocessing_context="fork")
    for number, examples in zip(numbers, loader, strict=True):
        places = torch.arange(number * new, (number + 1) * new) % latest
        pool[places.to(device)] = examples.to(device)
        step = number - ahead
        if step < first_step:
            continue
        rng = np.random.default_rng([seed, number, 1])  # so that a resumed run is the same
        indices = rng.choice(min((number + 1) * new, latest), count, replace=False)
        inputs, classes, weights = batch(pool[torch.from_numpy(indices).to(device)], rng)
        with torch.autocast(device, torch.bfloat16, enabled=device != "cpu"):
            logits = net(inputs.contiguous(memory_format=torch.channels_last))
        loss = _loss(logits.float(), classes, weights)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 2.0)
        optimiser.step()
        schedule.step()
        follow(average, net, max(0.001, 1 / (step + 1)))
        recent.append(loss.detach())
        if (step + 1) % 100 == 0:
            mean = float(torch.stack([*recent]).mean())
            print(f"step {step + 1} of {steps}: loss {mean:.4f}, {time.time() - start_s:.0f} s", flush=True)
            states = {name: part.state_dict() for name, part in parts.items()}
            torch.save({"step": step + 1} | states, checkpoint.with_suffix(".part"))
            checkpoint.with_suffix(".part").rename(checkpoint)
    frames = sum(len(sequence["rgb"]) * (1 + ("rgb_right" in sequence)) for sequence in sequences)
    return average.cpu().eval(), {"frames": frames, "steps": steps, "batch": count}


def _loss(logits: Tensor, classes: Tensor, weights: Tensor) -> Tensor:
    """Cross-entropy plus one minus the soft Dice overlap of each class."""
    probability = torch.sigmoid(logits)
    intersection = (weights * probability * classes).sum((0, 2, 3))
    union = (weights * (probability + classes)).sum((0, 2, 3))
    entropy = F.binary_cross_entropy_with_logits(logits, classes, weights)
    return 2 * entropy + (1 - (2 * intersection + 50) / (union + 50)).mean()
