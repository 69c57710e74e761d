"""Trains the networks of the corrections of flow and of depth on rendered and on closed-form motion.

With the defaults half are rendered sequences, as rendered and once more as from another camera (gain, colour,
contrast, noise, blur, JPEG; if monocular also another size, and some frames that cannot be tracked); warped
cortex under an instrument; and drawn textures in motion, which need no correction. Examples are stored: an
interrupted run continues. Depth is corrected after flow, hence trained after it.
"""

import copy
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from evidence.flow import scenes
from evidence.flow.scenes import (
    Field,
    add_noise,
    dilate,
    inside,
    inverse,
    jpeg,
    noise_field,
    pixels,
    resample,
)
from synth.arrays import Map, Mask, Pixels
from synth.errors import UserError
from synth.flow import correction, image
from synth.flow.segmentation import with_highlights
from synth.flow.stereo import depth_correction
from synth.flow.stereo.depth_motion import Change
from synth.flow.stereo.rig import Intrinsics, StereoRig
from synth.flow.stereo.stereo_track import Motion3D, StereoTracker, still_frames
from synth.flow.track import Tracker, track
from synth.flow.tvl1 import Tvl1
from weights.networks import CorrectionNet, follow

Pairs = tuple[tuple[int, int], ...]
Frames = dict[str, Any]  # arrays of a sequence, by name
_RGB, _TOOLS = ("rgb", "rgb_right"), ("tool", "tool_right")
_PRESSED = 2.5  # factor on the weight of depth at contacts
_CORRUPTED = 0.06  # share of frames that cannot be tracked
_FREEDOM, _PLAIN = 5.0, 2.0  # of Student's distribution; weight of the relative error in the loss
_LEAST = 0.03  # px (or units of depth) that what an example misses is at least taken for
_BATCH, _RATE = 8, 2e-3


def train(
    examples: Path, sequences: Sequence[Path], drawn: int, minutes: float, seed: int, *, depth: bool
) -> tuple[CorrectionNet, dict[str, Any]]:
    """The network of flow or depth after some CPU-minutes, and its data in numbers.

    `sequences`: files of `weights.chain`; `drawn`: number of drawn pairs; warped ones are a quarter of it.
    """
    examples.mkdir(parents=True, exist_ok=True)
    describe, repeats = (depth_example, 1) if depth else (example, 3)  # a drawn pair is a single frame
    makers: dict[str, Any] = {}
    for file in sequences:
        for variant in range(2):
            makers[f"{file.stem}_{variant}"] = lambda file=file, variant=variant: _vary(
                dict(np.load(file)), np.random.default_rng([*file.stem.encode(), variant]), variant, depth
            )
    rendered = set(makers)
    makers |= {
        f"g{i:04d}": lambda i=i: (_make_drawn_depth if depth else _make_drawn_pair)(i) for i in range(drawn)
    }
    makers |= {f"p{i:04d}": lambda i=i: _make_warped_pair(i) for i in range(0 if depth else drawn // 4)}
    dataset, frames = [], 0
    for name, make in makers.items():
        file = examples / f"{name}.npz"
        if not file.exists():
            np.savez(examples / "part.npz", allow_pickle=False, **describe(make()))
            (examples / "part.npz").rename(file)
        arrays = dict(np.load(file))
        dataset += (1 if name in rendered else repeats) * [arrays]
        frames += len(arrays["x"])
    net, steps = fit(dataset, depth, minutes, seed)
    return net, {"examples": len(makers), "frames": frames, "steps": steps}


def _make_warped_pair(index: int) -> Frames:
    """A pair with a pull under a tool, on drawn cortex."""
    rng = np.random.default_rng([77, index])
    size = int(rng.choice([192, 224]))
    recipe = scenes.Recipe(
        peak_px=float(rng.uniform(1, 14)),
        noise=float(rng.choice([0.5, 1.5, 3])),
        contrast=float(rng.uniform(0.4, 1)),
        glare=float(rng.uniform(0, 0.08)),
    )
    pair = next(scenes.pairs(recipe, 1, 9000 + index, size))
    hidden = np.stack([~pair.rest_usable, ~pair.now_usable])
    return _pair([pair.rest, pair.now], hidden, pair.flow, pair.inside, pair.hidden, pair.inside)


def _make_drawn_pair(index: int) -> Frames:
    """A pair of noise, ellipses, cortex or a photograph, perhaps with a bar as instrument, moving or still.

    Without these pairs the correction made flow worse on photographs, where it needs no correction.
    """
    rng = np.random.default_rng([4321, index])
    size = int(rng.choice([160, 192, 224]))
    texture, flow = draw_texture(2 * size, rng), draw_motion(size, rng)
    noise, quality = rng.choice([0.3, 1, 2, 4]), int(rng.choice([0, 0, 0, 92, 75]))
    before, after = (resample(texture, places) for places in (pixels(size, size), inverse(flow)))
    if rng.random() < 0.4:
        ramp = np.linspace(-1, 1, size, dtype=np.float32)[:, None]
        after = after * (1 + rng.uniform(-0.1, 0.1) * ramp + rng.uniform(-0.08, 0.08))
    bar = np.zeros((size, size), np.uint8)
    if rng.random() < 0.35:
        tip, angle = rng.uniform(0.3, 0.7, 2) * size, rng.uniform(0, 2 * np.pi)
        end = tip + 2 * size * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(bar, tip.astype(int).tolist(), end.astype(int).tolist(), 1, int(rng.uniform(4, 20)))
        after = np.where(bar[..., None] > 0, rng.uniform(40, 200), after)
    rgb = [jpeg(add_noise(picture, noise, rng), quality) for picture in (before, after)]
    hidden, in_view = np.stack([np.zeros_like(bar, bool), dilate(bar > 0, 3)]), inside(flow)
    covered = scenes.warp_to_rest(hidden[1], flow) > 0.5
    tissue = in_view if rng.random() < 0.5 else np.ones_like(in_view)
    return _pair(rgb, hidden, flow, in_view, covered, tissue)


def _make_drawn_depth(index: int) -> Frames:
    """Stereo pairs of drawn textures on a slope, with lateral motion and independent motion in depth."""
    rng = np.random.default_rng([8642, index])
    size = int(rng.choice([160, 192, 224]))
    texture, flow = draw_texture(2 * size, rng), draw_motion(size, rng)
    distance, baseline, width_mm = rng.uniform(150, 400), rng.uniform(8, 40), np.exp(rng.uniform(2.3, 4.1))
    focal, offsets = size * distance / width_mm, pixels(size, size) - size / 2
    rest = distance * (1 + (offsets @ rng.normal(0, 0.2, 2)) / focal)
    relief = noise_field((size, size), float(rng.uniform(0.1, 1) * size), rng)
    length = np.linalg.norm(flow, axis=-1)
    depth = relief * rng.uniform(0, 0.7) * (rng.random() < 0.7)
    depth = depth + length * distance / focal * rng.uniform(-1, 1)
    middle = focal * baseline / distance
    rest_disparity, disparity = (focal * baseline / z - middle for z in (rest, rest + depth))
    images, noise, nothing = {}, rng.choice([0.3, 1, 2, 4]), np.zeros_like(rest_disparity)
    for name, side in zip(_RGB, (0, 1), strict=True):
        shifts = (
            -side * np.stack([rest_disparity, nothing], -1),
            flow - side * np.stack([disparity, nothing], -1),
        )
        pictures = np.stack([resample(texture, inverse(shift)) for shift in shifts])
        images[name] = add_noise(pictures, noise, rng)
    K, other = (np.array([[focal, 0, size / 2 + c], [0, focal, size / 2], [0, 0, 1]]) for c in (0, middle))
    unblocked = np.zeros((2, size, size), bool)
    return images | {
        "tool": unblocked,
        "tool_right": unblocked,
        "tissue": np.ones((size, size), bool),
        "visible": np.stack(2 * [inside(flow)]),
        "pressed": unblocked,
        "motion": np.stack([np.zeros_like(depth), depth])[..., None] * [0, 0, 1],
        "K": K,
        "Kr": other,
        "dist": np.zeros(5),
        "distr": np.zeros(5),
        "baseline": baseline,
    }


def _pair(rgb: list[Any], hidden: Any, flow: Any, in_view: Any, covered: Any, tissue: Any) -> Frames:
    length = np.linalg.norm(flow, axis=-1)
    pressed = (length > 0.7 * max(float(length.max()), 1e-6)) & in_view
    return {
        "rgb": np.stack(rgb),
        "hidden": hidden,
        "tissue": tissue,
        "flow": np.stack([np.zeros_like(flow), flow]),
        "visible": np.stack([in_view, in_view & ~covered]),
        "pressed": np.stack([pressed, pressed]),
    }


def draw_texture(size: int, rng: np.random.Generator) -> Any:
    kind, square = rng.integers(4), (size, size)
    if kind == 0:
        periods = np.exp(rng.uniform(np.log(4), np.log(60), rng.integers(1, 4)))
        grey = sum(rng.uniform(0.2, 1) * noise_field(square, float(period), rng) for period in periods)
        tint = rng.uniform(10, 45) * rng.uniform(0.3, 1.3, 3)
        channels = [noise_field(square, float(rng.uniform(6, 60)), rng) for _ in range(3)]
        spread = rng.uniform(2, 20) if rng.random() < 0.5 else 0
        return np.float32(
            rng.uniform(60, 180, 3) + np.asarray(grey)[..., None] * tint + spread * np.stack(channels, -1)
        )
    if kind == 1:
        leaves = np.zeros((*square, 3), np.float32) + np.float32(rng.uniform(40, 200, 3))
        for _ in range(rng.integers(60, 400)):
            radius = int(np.exp(rng.uniform(np.log(4), np.log(size / 4))))
            axes, middle = (radius, int(radius * rng.uniform(0.2, 1))), rng.integers(0, size, 2).tolist()
            colour, turn = rng.uniform(10, 245, 3).tolist(), float(rng.uniform(0, 180))
            cv2.ellipse(leaves, middle, axes, turn, 0, 360, colour, -1, cv2.LINE_AA)
        rough = rng.uniform(0, 10) * noise_field(square, float(rng.uniform(4, 20)), rng)
        return cv2.GaussianBlur(leaves, (0, 0), float(rng.uniform(0.7, 2))) + rough[..., None]
    if kind == 2:
        return 255 * scenes.cortex(size, rng)
    photographs, tint = scenes.photographs_of("tuning", 384), np.eye(3) + rng.normal(0, 0.25, (3, 3))
    photograph = photographs[int(rng.integers(len(photographs)))]
    side = int(rng.integers(192, 385))
    top, left = rng.integers(0, 385 - side, 2)
    crop = cv2.resize(photograph[top : top + side, left : left + side], square, interpolation=cv2.INTER_CUBIC)
    return np.float32(np.clip(crop @ tint.T * rng.uniform(0.5, 1.2), 0, 255))


def draw_motion(size: int, rng: np.random.Generator) -> Any:
    """Displacement (H, W, 2) px of a pull, a smooth field, an affine motion, or none."""
    kind = rng.integers(4)
    if kind == 0:
        field = Field.draw("pull", size, rng, float(rng.uniform(0.06, 0.2)))
        return float(rng.uniform(0.2, 10)) * field.at(pixels(size, size))
    if kind == 1:
        period = float(rng.uniform(0.4, 1.5) * size)
        return np.stack([noise_field((size, size), period, rng) for _ in range(2)], -1) * rng.uniform(0.1, 3)
    affine, shift = rng.normal(0, 0.01, (2, 2)), rng.normal(0, 2, 2)
    middle = pixels(size, size) - size / 2
    return np.float32(middle @ affine.T + shift) * (kind == 2)


def example(frames: Frames) -> Frames:
    """Features, error of the flow and weights of the frames: x, y, w, each (T - 1, C, h, w)."""
    rgb, tissue = frames["rgb"], frames["tissue"]
    hidden = frames["hidden"] if "hidden" in frames else with_highlights(rgb, frames["tool"])
    tracker = Tracker(Tvl1(corrected=False), rgb[0], hidden[0], tissue)
    rows = []
    rest = _normalise(rgb[0], tracker.usable)
    for t in range(1, len(rgb)):
        tracker.step(rgb[t], hidden[t])
        assert tracker.last is not None
        flow, confidence = tracker.last.flow, tracker.last.confidence
        normalised, along = _normalise(rgb[t], ~hidden[t]), np.ascontiguousarray(np.moveaxis(flow, -1, 0))
        warped, usable = image.warp(normalised, image.flags(~hidden[t]), along)
        x = correction.describe(rgb[0], rgb[t], tracker.usable, (rest, warped), usable, flow, confidence)
        missing = ((frames["flow"][t] - flow) * tissue[..., None]).transpose(2, 0, 1)
        share = correction.means(1.0 * tissue)
        y = correction.means(*missing) / np.maximum(share, 0.05)
        visible, pressed = frames["visible"][t] & tissue, frames["pressed"][t] & tissue
        rows.append((x, y, _weight(share, *correction.means(visible, pressed))))
    return _example(rows)


def _weight(share: Any, visible: Any, pressed: Any) -> Any:
    """Weights (1, h, w) of cells: low for hidden ones, high at contacts."""
    return (share * (0.2 + 0.8 * visible) * (1 + 3 * pressed)).reshape(1, *visible.shape)


def _example(rows: list[Any]) -> Frames:
    padded = [[correction.pad_cells(np.asarray(array, np.float32)) for array in row] for row in rows]
    return {name: np.stack(column) for name, column in zip("xyw", zip(*padded, strict=True), strict=True)}


class _Observed(StereoTracker):
    """Tracker that stores the network's features and the uncorrected depth motion (H, W) mm of a frame."""

    def _measure_motion(self, change: Change, flow: Any, confidence: Any, is_lost: bool) -> Motion3D:
        r = self.rectified
        self.features, _ = self.describe(change, flow, confidence)
        self.depth = r.depth(self.rest.disparity + change.px) - r.depth(self.rest.disparity)
        return Motion3D.zeros(self.tissue.shape)


def depth_example(frames: Frames) -> Frames:
    """As `example`, for the depth solver: y in units of `depth_correction`."""
    tissue = frames["tissue"]
    hidden = [with_highlights(frames[rgb], frames[tool]) for rgb, tool in zip(_RGB, _TOOLS, strict=True)]
    flow_track = track(Tvl1(), frames["rgb"], hidden[0], tissue)
    cameras = Intrinsics(frames["K"], frames["dist"]), Intrinsics(frames["Kr"], frames["distr"])
    pair = StereoRig(*cameras, np.eye(3), np.array([-float(frames["baseline"]), 0, 0]), tissue.shape[::-1])
    still_count = still_frames(flow_track.flow, tissue)
    left, right = (frames[rgb] for rgb in _RGB)
    try:
        tracker = _Observed(pair, left[:still_count], right[:still_count], hidden[0][0], hidden[1][0], tissue)
    except UserError:  # too blurred or noisy to match left and right: an example without weight
        return _example([[np.zeros((n, 30, 40), np.float32) for n in (depth_correction.CHANNELS, 1, 1)]])
    rows, r, coarse = [], tracker.rectified, tracker.solver.average_cells
    inside = r.flags(tissue, 0).astype(np.float32)
    for t in range(1, len(frames["rgb"])):
        tracker.step(
            left[t], right[t], hidden[0][t], hidden[1][t], flow_track.flow[t], flow_track.confidence[t]
        )
        visible_tissue = frames["visible"][t] & tissue
        true, visible, pressed = (
            r.picture(np.ascontiguousarray(plane, np.float32), 0)
            for plane in (frames["motion"][t][..., 2], visible_tissue, visible_tissue & frames["pressed"][t])
        )
        share = coarse(inside)
        missing = coarse((true - tracker.depth) * inside) / np.maximum(share, 0.05) / depth_correction.UNIT_MM
        weight = _weight(share, coarse(visible).clip(0, 1), coarse(pressed).clip(0, 1))
        weight[weight > 1] *= _PRESSED
        rows.append((tracker.features, missing[None], weight))
    return _example(rows)


def _normalise(rgb: Pixels, usable: Mask) -> Map:
    return image.normalise(image.luminance(rgb), image.flags(usable))


def _vary(frames: Frames, rng: np.random.Generator, variant: int, depth: bool) -> Frames:
    """The frames as from another camera if `variant`; those of the right camera too if for depth."""
    if not variant:
        return frames
    if not depth and rng.random() < 0.5:
        frames = _resize(frames, float(np.exp(rng.uniform(np.log(0.7), np.log(1.35)))))
    gain, gamma, white = rng.uniform(0.6, 1.3), np.exp(rng.normal(0, 0.15)), np.exp(rng.normal(0, 0.08, 3))
    contrast = rng.uniform(0.5, 1.1) if rng.random() < 0.4 else 1.0
    noise, blur, drift = rng.choice([0, 1, 2, 4]), rng.choice([0, 0, 0.5, 0.9]), rng.normal(0, 0.05)
    quality = int(rng.choice([0, 95, 85, 70, 50]))
    pictures_by_name: dict[str, list[Any]] = {name: [] for name in (_RGB if depth else _RGB[:1])}
    for name in pictures_by_name:
        balance = white * np.exp(rng.normal(0, 0.03, 3))
        for t, picture in enumerate(frames[name]):
            level = picture / 255.0
            level = cv2.GaussianBlur(level, (0, 0), float(blur)) if blur else level
            level = np.clip(level.mean((0, 1)) + contrast * (level - level.mean((0, 1))), 0, 1)
            level = 255 * np.clip(gain * (1 + drift * t / 7) * balance * level**gamma, 0, 1)
            encoded = jpeg(add_noise(level, noise, rng), quality)
            is_corrupt = not depth and t and rng.random() < _CORRUPTED
            pictures_by_name[name].append(_corrupt(encoded, rng) if is_corrupt else encoded)
    return frames | {name: np.stack(pictures) for name, pictures in pictures_by_name.items()}


def _resize(frames: Frames, share: float) -> Frames:
    old_size = np.array(frames["tissue"].shape[::-1])
    size = [round(edge * share / 4) * 4 for edge in old_size.tolist()]

    def resize(stack: Any, interpolation: int) -> Any:
        return np.stack([cv2.resize(picture, size, interpolation=interpolation) for picture in stack])

    masks = {name: a for name, a in frames.items() if a.dtype == bool and a.ndim > 2}
    small = {name: resize(a.astype(np.uint8), cv2.INTER_NEAREST) > 0 for name, a in masks.items()}
    tissue = resize(frames["tissue"][None].astype(np.uint8), cv2.INTER_NEAREST)[0] > 0
    flow = resize(frames["flow"].astype(np.float32), cv2.INTER_LINEAR) * np.float32(size / old_size)
    rgb = resize(frames["rgb"], cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC)
    return small | {"tissue": tissue, "flow": flow, "rgb": rgb}


def _corrupt(picture: Pixels, rng: np.random.Generator) -> Pixels:
    """The image dark, out of focus, shifted or rotated: untrackable, so that the variance must be large."""
    ways = (
        lambda: (picture * 0.02).astype(np.uint8),
        lambda: cv2.GaussianBlur(picture, (0, 0), rng.uniform(2, 5)),
        lambda: np.roll(picture, rng.integers(15, 40, 2) * rng.choice([-1, 1], 2), (0, 1)),
        lambda: picture[::-1, ::-1],
    )
    return np.ascontiguousarray(ways[int(rng.integers(4))]())


def fit(examples: list[Frames], depth: bool, minutes: float, seed: int) -> tuple[CorrectionNet, int]:
    """The network after training for some minutes of one core, its weights averaged over the last steps."""
    torch.manual_seed(seed)
    rng, kind = np.random.default_rng(seed), depth_correction if depth else correction
    net = CorrectionNet(kind.CHANNELS, 1 if depth else 2)
    _standardise(net, examples, kind.VECTORS)
    average, optimiser = copy.deepcopy(net), torch.optim.AdamW(net.parameters(), _RATE, weight_decay=1e-3)
    groups: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    for i, entry in enumerate(examples):
        groups.setdefault(entry["x"].shape[-2:], []).extend((i, t) for t in range(len(entry["x"])))
    chances = np.array([len(group) for group in groups.values()], float)
    start, steps = time.process_time(), 0
    while (share := (time.process_time() - start) / (60 * minutes)) < 1:
        rate = _RATE * min(1, steps / 200) * (0.5 * (1 + np.cos(np.pi * share)) + 0.005)
        optimiser.param_groups[0]["lr"] = rate
        group = list(groups.values())[rng.choice(len(groups), p=chances / chances.sum())]
        batch = [group[k] for k in rng.integers(len(group), size=_BATCH)]
        x, y, w = (torch.from_numpy(np.stack([examples[i][n][t] for i, t in batch])).float() for n in "xyw")
        # Depth depends on the direction of the baseline: its features aren't rotated.
        x, y, w = _rotate(x, y, w, int(rng.integers(4 if depth else 8)), kind.VECTORS)
        optimiser.zero_grad()
        _loss(net(x), y, w).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        steps += 1
        follow(average, net, max(0.002, 9 / (steps + 10)))
    return average.eval(), steps


def _standardise(net: CorrectionNet, examples: list[Frames], vectors: Pairs) -> None:
    """Scales channels to mean 0 and deviation 1; vectors retain their direction."""
    samples = np.concatenate(
        [np.moveaxis(entry["x"], 1, -1).reshape(-1, entry["x"].shape[1])[::60] for entry in examples]
    )
    mean, deviation = samples.mean(0, dtype=np.float64), samples.std(0, dtype=np.float64)
    for pair in map(list, vectors):
        mean[pair], deviation[pair] = 0, deviation[pair].mean()
    net.mean[0, :, 0, 0], net.deviation[0, :, 0, 0] = torch.from_numpy(mean), torch.from_numpy(deviation)


def _rotate(x: Tensor, y: Tensor, w: Tensor, turn: int, vectors: Pairs) -> tuple[Tensor, Tensor, Tensor]:
    """One of the eight rotations and reflections; y is a vector field if it has two channels."""
    for bit, side, axis in ((1, -1, 0), (2, -2, 1)):
        if turn & bit:
            x, y, w = x.flip(side).clone(), y.flip(side).clone(), w.flip(side)
            x[:, [pair[axis] for pair in vectors]] *= -1
            if y.shape[1] == 2:
                y[:, axis] *= -1
    if turn & 4:
        order = list(range(x.shape[1]))
        for i, j in vectors:
            order[i], order[j] = j, i
        x, y, w = x[:, order].mT.contiguous(), y.flip(1).mT, w.mT
    return x, y, w


def _loss(output: Tensor, missing: Tensor, weight: Tensor) -> Tensor:
    """Mean over the examples, whose errors count in proportion to what each misses.

    Errors in px would be lowered most where much is missing, and motion that is recovered well made worse.
    """
    predicted, log_variance = output.chunk(2, 1)
    error, log_variance = missing - predicted, log_variance.clamp(-8, 5)
    surprise = torch.log1p(error**2 / (_FREEDOM * torch.exp(log_variance)))
    nll = 0.5 * log_variance + 0.5 * (_FREEDOM + 1) * surprise
    total = weight.sum((1, 2, 3), keepdim=True) * missing.shape[1] + 1e-6
    typical = (weight * missing.abs()).sum((1, 2, 3), keepdim=True) / total + _LEAST
    loss = weight * (nll + _PLAIN * torch.sqrt(error**2 + (0.1 * typical) ** 2) / typical)
    return (loss.sum((1, 2, 3), keepdim=True) / total).mean()
