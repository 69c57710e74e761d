"""Trains the flow's correction on rendered truth, and on closed forms that no renderer drew.

Run: python -m evidence.flow.correction_training EXAMPLES [--scenes 477 --minutes 30]

Sequences of `mission`, each as rendered and once more as another camera might show it (size, gain, colour,
contrast, noise, blur, JPEG; now and then a frame that can't be followed), the warped pairs of
`evidence.flow.scenes`, and drawn textures in motion. EXAMPLES keeps what was made, so that a run that was
stopped goes on. Writes `correction.pt` and `correction.json` beside `synth.flow.correction`.
"""

from __future__ import annotations

import copy
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from evidence import report
from evidence.flow.scenes import Recipe, cortex, inverse, noise_field, pairs, pixels, pull_field, sample
from synth.flow import correction, image, mask_detection
from synth.flow.track import track
from synth.flow.tvl1 import Tvl1
from synth.job import reader
from synth.sequence.scene import simulate

Film = dict[str, Any]
"""Arrays by name."""
_SHORT = 0.06  # of frames are such as can't be followed
_FREEDOM, _PLAIN = 5.0, 4.0  # of Student's distribution; weight of the error itself beside its likelihood
_BATCH, _RATE = 8, 2e-3


def main(
    examples: Path,
    scenes: int = 477,
    closed: int = 160,
    drawn: int = 600,
    minutes: float = 30.0,
    seed: int = 0,
) -> None:
    """Follows sequences, pulls and drawn pairs, as many as asked, and trains for so many CPU-minutes."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    examples.mkdir(parents=True, exist_ok=True)
    films = _films(scenes, closed, drawn)
    for name, make in films:
        if not (examples / f"{name}.npz").exists():
            np.savez(examples / "part.npz", allow_pickle=False, **example(make()))
            (examples / "part.npz").rename(examples / f"{name}.npz")
    found = {name: dict(np.load(examples / f"{name}.npz")) for name, _ in films}
    net, steps = fit([found[name] for name, _ in films], minutes, seed)
    torch.save({k: v.half() for k, v in net.state_dict().items()}, correction.WEIGHTS)
    card = {
        "trained_on": f"sequences 0 to {scenes - 1} of mission, {closed} pulls, {drawn} drawn pairs",
        "frames": sum(len(one["x"]) for one in found.values()),
        "cpu_minutes": minutes,
        "steps": steps,
        "parameters": sum(p.numel() for p in net.parameters()),
        "torch": torch.__version__,
    }
    report.save(correction.WEIGHTS.parent, "correction.json", card)
    report.show(card)


def _films(scenes: int, closed: int, drawn: int) -> list[tuple[str, Any]]:
    """Names of examples, and what makes their films."""
    job = reader.load_job("mission")
    rendered = [
        (f"{i:05d}_{k}", lambda i=i, k=k: _varied(_rendered(job, i), np.random.default_rng([i, k]), k))
        for i in range(scenes)
        for k in range(2)
    ]
    warped = [(f"p{i:04d}", lambda i=i: _warped(i)) for i in range(closed)]
    return rendered + warped + 3 * [(f"g{i:04d}", lambda i=i: _drawn(i)) for i in range(drawn)]


def _rendered(job: Any, index: int) -> Film:
    """Pictures `rgb`, `hidden` places, `tissue`, and the truth: `flow`, `visible`, and where `pressed`."""
    scene = simulate(job, index)
    frames = list(scene.frames())
    film = {name: np.stack([getattr(f, name) for f in frames]) for name in ("rgb", "tool", "flow", "visible")}
    size = np.linalg.norm(np.stack([f.traction for f in frames]), axis=-1)
    pressed = size > 0.05 * np.maximum(size.max((1, 2), keepdims=True), 1e-6)
    return film | {"pressed": pressed, "tissue": scene.tissue}


def _warped(index: int) -> Film:
    """A pull under a tool on drawn cortex."""
    rng = np.random.default_rng([77, index])
    recipe = replace(
        Recipe(),
        size=int(rng.choice([192, 224])),
        pull=float(rng.uniform(1, 14)),
        noise=float(rng.choice([0.5, 1.5, 3])),
        contrast=float(rng.uniform(0.4, 1)),
        highlights=float(rng.uniform(0, 0.08)),
    )
    pair = next(pairs(recipe, 1, 9000 + index))
    hidden = np.stack([~pair.rest_usable, ~pair.now_usable])
    return _pair([pair.rest, pair.now], hidden, pair.flow, pair.inside, pair.hidden, pair.inside)


def _drawn(index: int) -> Film:
    """Noise, leaves or cortex without instrument or with a bar, in any motion and in none.

    Without them the correction made flow worse on photographs, whose flow lacks nothing.
    """
    rng = np.random.default_rng([4321, index])
    size = int(rng.choice([160, 192, 224]))
    texture, flow = _texture(2 * size, rng), _motion(size, rng)
    noise, quality = rng.choice([0.3, 1, 2, 4]), int(rng.choice([0, 0, 0, 92, 75]))
    at = pixels(size, size)
    before, after = (
        np.stack([sample(texture[..., c], (places + 0.5) * 2 - 0.5) for c in range(3)], -1)
        for places in (at, inverse(flow))
    )
    if rng.random() < 0.4:
        ramp = np.linspace(-1, 1, size, dtype=np.float32)[:, None]
        after = after * (1 + rng.uniform(-0.1, 0.1) * ramp + rng.uniform(-0.08, 0.08))
    bar = np.zeros((size, size), np.uint8)
    if rng.random() < 0.35:
        tip, angle = rng.uniform(0.3, 0.7, 2) * size, rng.uniform(0, 2 * np.pi)
        end = tip + 2 * size * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(bar, tip.astype(int).tolist(), end.astype(int).tolist(), 1, int(rng.uniform(4, 20)))
        after = np.where(bar[..., None] > 0, rng.uniform(40, 200), after)
    rgb = [
        _jpeg(np.clip(np.round(one + rng.normal(0, noise, one.shape)), 0, 255).astype(np.uint8), quality)
        for one in (before, after)
    ]
    hidden = np.stack([np.zeros_like(bar), cv2.dilate(bar, np.ones((3, 3), np.uint8))]) > 0
    inside = np.all((at + flow >= 0) & (at + flow <= size - 1), axis=-1)
    there = (at + flow).astype(np.float32)
    covered = cv2.remap(hidden[1].astype(np.float32), there[..., 0], there[..., 1], cv2.INTER_LINEAR) > 0.5
    return _pair(rgb, hidden, flow, inside, covered, inside if rng.random() < 0.5 else np.ones_like(inside))


def _pair(rgb: list[Any], hidden: Any, flow: Any, inside: Any, covered: Any, tissue: Any) -> Film:
    length = np.linalg.norm(flow, axis=-1)
    pressed = (length > 0.7 * max(float(length.max()), 1e-6)) & inside
    return {
        "rgb": np.stack(rgb),
        "hidden": hidden,
        "tissue": tissue,
        "flow": np.stack([np.zeros_like(flow), flow]),
        "visible": np.stack([inside, inside & ~covered]),
        "pressed": np.stack([pressed, pressed]),
    }


def _texture(size: int, rng: np.random.Generator) -> Any:
    kind, square = rng.integers(3), (size, size)
    if kind == 0:
        periods = np.exp(rng.uniform(np.log(4), np.log(60), rng.integers(1, 4)))
        grey = sum(rng.uniform(0.2, 1) * noise_field(square, float(period), rng) for period in periods)
        tint = rng.uniform(10, 45) * rng.uniform(0.3, 1.3, 3)
        own = [noise_field(square, float(rng.uniform(6, 60)), rng) for _ in range(3)]
        spread = rng.uniform(2, 20) if rng.random() < 0.5 else 0
        return np.float32(
            rng.uniform(60, 180, 3) + np.asarray(grey)[..., None] * tint + spread * np.stack(own, -1)
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
    return 255 * cortex(size, rng)


def _motion(size: int, rng: np.random.Generator) -> Any:
    """(H, W, 2) px: a pull, a smooth field, an affine motion, or none."""
    kind = rng.integers(4)
    if kind == 0:
        direction, reach = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0.06, 0.2))
        return pull_field(
            Recipe(size=size, pull=float(rng.uniform(0.2, 10)), direction=direction, reach=reach)
        )
    if kind == 1:
        period = float(rng.uniform(0.4, 1.5) * size)
        return np.stack([noise_field((size, size), period, rng) for _ in range(2)], -1) * rng.uniform(0.1, 3)
    affine, shift = rng.normal(0, 0.01, (2, 2)), rng.normal(0, 2, 2)
    middle = pixels(size, size) - size / 2
    return np.float32(middle @ affine.T + shift) * (kind == 2)


def example(film: Film) -> Film:
    """What the network sees of a film, what its flow misses, and weights: (T - 1, C, h, w) x, y, w."""
    rgb, tissue = film["rgb"], film["tissue"]
    hidden = film["hidden"] if "hidden" in film else mask_detection.hidden(rgb, film["tool"])
    found = track(Tvl1(corrected=False), rgb, hidden, tissue)
    rows = []
    usable, share = tissue & ~hidden[0], correction.means(1.0 * tissue)
    rest = _normalised(rgb[0], usable)
    for t in range(1, len(rgb)):
        now, along = _normalised(rgb[t], ~hidden[t]), torch.from_numpy(found.flow[t]).movedim(-1, 0)[None]
        warped, seen = (one[0, 0].numpy() for one in image.warp(now, image.flags(~hidden[t]), along))
        flow, greys = found.flow[t], (rest[0, 0].numpy(), warped)
        x = correction.describe(rgb[0], rgb[t], usable, greys, seen, flow, found.confidence[t])
        missing = ((film["flow"][t] - flow) * tissue[..., None]).transpose(2, 0, 1)
        y = correction.means(*missing) / np.maximum(share, 0.05)
        visible, pressed = film["visible"][t] & tissue, film["pressed"][t] & tissue
        w = share * (0.2 + 0.8 * correction.means(visible)) * (1 + 3 * correction.means(pressed))
        rows.append([correction.padded(np.asarray(one, np.float32)) for one in (x, y, w)])
    return {name: np.stack(column) for name, column in zip("xyw", zip(*rows, strict=True), strict=True)}


def _normalised(rgb: NDArray[np.uint8], usable: NDArray[np.bool_]) -> Tensor:
    return image.normalise(image.tensor(rgb), image.flags(usable))


def _varied(film: Film, rng: np.random.Generator, again: int) -> Film:
    """A film as another camera might show it; as it is the first time."""
    if not again:
        return film
    film = (
        _resized(film, float(np.exp(rng.uniform(np.log(0.7), np.log(1.35))))) if rng.random() < 0.5 else film
    )
    gain, gamma, white = rng.uniform(0.6, 1.3), np.exp(rng.normal(0, 0.15)), np.exp(rng.normal(0, 0.08, 3))
    contrast = rng.uniform(0.5, 1.1) if rng.random() < 0.4 else 1.0
    noise, blur, drift = rng.choice([0, 1, 2, 4]), rng.choice([0, 0, 0.5, 0.9]), rng.normal(0, 0.05)
    quality = int(rng.choice([0, 95, 85, 70, 50]))
    shown = []
    for t, picture in enumerate(film["rgb"]):
        one = picture / 255.0
        one = cv2.GaussianBlur(one, (0, 0), float(blur)) if blur else one
        one = np.clip(one.mean((0, 1)) + contrast * (one - one.mean((0, 1))), 0, 1)
        one = 255 * np.clip(gain * (1 + drift * t / 7) * white * one**gamma, 0, 1)
        one = np.clip(np.round(one + noise * rng.standard_normal(one.shape)), 0, 255).astype(np.uint8)
        shown.append(
            _spoilt(_jpeg(one, quality), rng) if t and rng.random() < _SHORT else _jpeg(one, quality)
        )
    return film | {"rgb": np.stack(shown)}


def _resized(film: Film, share: float) -> Film:
    height, width = film["tissue"].shape
    size = round(width * share / 4) * 4, round(height * share / 4) * 4

    def resize(stack: Any, how: int) -> Any:
        frames = stack if stack.ndim > 2 else stack[None]
        frames = frames.astype(np.uint8) if stack.dtype == bool else frames
        made = np.stack([cv2.resize(one, size, interpolation=how) for one in frames]).astype(stack.dtype)
        return made if stack.ndim > 2 else made[0]

    small = {name: resize(a, cv2.INTER_NEAREST) for name, a in film.items() if a.dtype == bool}
    flow = resize(film["flow"], cv2.INTER_LINEAR) * np.array([size[0] / width, size[1] / height], np.float32)
    return small | {
        "flow": flow,
        "rgb": resize(film["rgb"], cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC),
    }


def _jpeg(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    if not quality:
        return picture
    _, packed = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)[..., ::-1]


def _spoilt(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Dark, out of focus, shifted or turned: nothing is to be followed, and the variance must say so."""
    ways = (
        lambda: (picture * 0.02).astype(np.uint8),
        lambda: cv2.GaussianBlur(picture, (0, 0), rng.uniform(2, 5)),
        lambda: np.roll(picture, rng.integers(15, 40, 2) * rng.choice([-1, 1], 2), (0, 1)),
        lambda: picture[::-1, ::-1],
    )
    return np.ascontiguousarray(ways[int(rng.integers(4))]())


def fit(examples: list[Film], minutes: float, seed: int) -> tuple[correction.CorrectionNet, int]:
    """The network after so many minutes of one core, its weights averaged over the last steps."""
    torch.manual_seed(seed)
    rng, net = np.random.default_rng(seed), correction.CorrectionNet()
    _standardise(net, examples)
    average, optimiser = copy.deepcopy(net), torch.optim.AdamW(net.parameters(), _RATE, weight_decay=1e-3)
    groups: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    for i, one in enumerate(examples):
        groups.setdefault(one["x"].shape[-2:], []).extend((i, t) for t in range(len(one["x"])))
    chances = np.array([len(group) for group in groups.values()], float)
    began, steps = time.process_time(), 0
    while (share := (time.process_time() - began) / (60 * minutes)) < 1:
        rate = _RATE * min(1, steps / 200) * (0.5 * (1 + np.cos(np.pi * share)) + 0.005)
        optimiser.param_groups[0]["lr"] = rate
        group = list(groups.values())[rng.choice(len(groups), p=chances / chances.sum())]
        drawn = [group[k] for k in rng.integers(len(group), size=_BATCH)]
        x, y, w = (torch.from_numpy(np.stack([examples[i][n][t] for i, t in drawn])).float() for n in "xyw")
        x, y, w = _turned(x, y, w, int(rng.integers(8)))
        optimiser.zero_grad()
        _loss(net(x), y, w).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        steps += 1
        with torch.no_grad():
            for kept, now in zip(average.parameters(), net.parameters(), strict=True):
                kept.lerp_(now, max(0.002, 9 / (steps + 10)))
    return average.eval(), steps


def _standardise(net: correction.CorrectionNet, examples: list[Film]) -> None:
    """Every channel to about mean 0 and deviation 1; vectors keep their direction."""
    some = np.concatenate(
        [one["x"].transpose(0, 2, 3, 1).reshape(-1, correction.CHANNELS)[::60] for one in examples]
    )
    mean, deviation = some.mean(0, dtype=np.float64), some.std(0, dtype=np.float64)
    for pair in map(list, correction.VECTORS):
        mean[pair], deviation[pair] = 0, deviation[pair].mean()
    net.mean[0, :, 0, 0], net.deviation[0, :, 0, 0] = torch.from_numpy(mean), torch.from_numpy(deviation)


def _turned(x: Tensor, y: Tensor, w: Tensor, turn: int) -> tuple[Tensor, Tensor, Tensor]:
    """One of the eight turned and mirrored views of the same."""
    for bit, side, axis in ((1, -1, 0), (2, -2, 1)):
        if turn & bit:
            x, y, w = x.flip(side).clone(), y.flip(side).clone(), w.flip(side)
            x[:, [pair[axis] for pair in correction.VECTORS]] *= -1
            y[:, axis] *= -1
    if turn & 4:
        order = list(range(correction.CHANNELS))
        for i, j in correction.VECTORS:
            order[i], order[j] = j, i
        x, y, w = x[:, order].mT.contiguous(), y.flip(1).mT, w.mT
    return x, y, w


def _loss(found: Tensor, missing: Tensor, weight: Tensor) -> Tensor:
    error, log_variance = missing - found[:, :2], found[:, 2:].clamp(-8, 5)
    surprise = torch.log1p(error**2 / (_FREEDOM * torch.exp(log_variance)))
    likely = 0.5 * log_variance + 0.5 * (_FREEDOM + 1) * surprise
    return (weight * (likely + _PLAIN * torch.sqrt(error**2 + 1e-4))).sum() / weight.sum()


if __name__ == "__main__":
    typer.run(main)
