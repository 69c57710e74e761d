"""Trains the tool mask's U-Net on the masks of a rendered dataset.

    synth render docs/results/learn/data/rendered.yaml -o DATA
    python -m bench.flow_toolnet DATA --steps 450 --seed 0 -o synth/flow

Writes `toolnet.pt` (half precision) and `toolnet.json` (data, seed, steps, overlap on held-out sequences).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from synth.flow import toolnet
from synth.store import Dataset

_HELD_OUT = 0.2
_BATCH = 8
_RATE = 3e-3

Picture = NDArray[np.uint8]
Flags = NDArray[np.bool_]


def train(data: Path, out: Path, steps: int, seed: int) -> dict[str, float | int | str]:
    """Trains, writes weights and card into `out`, and gives the card back.

    Args:
        data: dataset with tools in view.
        out: folder.
        steps: of AdamW, batches of 8.
        seed: of everything drawn.

    Raises:
        UserError: no finished sequence in `data`.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    sequences = [_load(np.asarray(s["rgb"][:]), np.asarray(s["tool"][:])) for s in Dataset(data)]
    kept = max(1, round((1 - _HELD_OUT) * len(sequences)))
    training = [frame for sequence in sequences[:kept] for frame in sequence]
    net = toolnet.ToolNet()
    optimiser = torch.optim.AdamW(net.parameters(), _RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    net.train()
    for step, (pictures, masks) in zip(range(steps), _batches(training, rng), strict=False):
        loss = _loss(net(pictures), masks)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if step % 20 == 0:
            print(f"step {step} loss {float(loss.detach()):.4f}", flush=True)
    net.eval()
    overlap = [_overlap(net, *frame) for sequence in sequences[kept:] for frame in sequence]
    out.mkdir(parents=True, exist_ok=True)
    torch.save({k: v.half() if v.is_floating_point() else v for k, v in net.state_dict().items()},
               out / "toolnet.pt")  # fmt: skip
    card: dict[str, float | int | str] = {
        "command": f"python -m bench.flow_toolnet DATA --steps {steps} --seed {seed}",
        "frames": len(training),
        "held_out_frames": len(overlap),
        "held_out_iou": round(float(np.mean(overlap)), 4) if overlap else float("nan"),
        "parameters": sum(p.numel() for p in net.parameters()),
        "torch": torch.__version__,
    }
    (out / "toolnet.json").write_text(json.dumps(card, indent=1) + "\n")
    return card


def _load(rgb: NDArray[np.uint8], tool: Flags) -> list[tuple[Picture, Flags]]:
    """Frames shrunk to twice what the net sees."""
    share = min(1.0, 2 * toolnet.SIDE / max(rgb.shape[1:3]))
    size = (round(rgb.shape[2] * share), round(rgb.shape[1] * share))
    return [
        (
            cv2.resize(picture, size, interpolation=cv2.INTER_AREA),
            cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool),
        )
        for picture, mask in zip(rgb, tool, strict=True)
    ]


def _batches(
    frames: list[tuple[Picture, Flags]], rng: np.random.Generator
) -> Iterator[tuple[Tensor, Tensor]]:
    while True:
        drawn = [frames[int(k)] for k in rng.integers(len(frames), size=_BATCH)]
        chosen = [_vary(picture, mask, rng) for picture, mask in drawn]
        pictures = torch.from_numpy(np.stack([toolnet.prepare(picture) for picture, _ in chosen]))
        masks = torch.from_numpy(np.stack([mask for _, mask in chosen]))[:, None].float()
        small = F.interpolate(masks, size=(toolnet.SIDE, toolnet.SIDE), mode="area")
        yield pictures, F.avg_pool2d(small, 2)


def _vary(picture: Picture, mask: Flags, rng: np.random.Generator) -> tuple[Picture, Flags]:
    """Turned, mirrored, zoomed and cropped square; other light, other steel, other colour of the field."""
    side = min(mask.shape)
    turn, zoom = rng.uniform(0, 360), rng.uniform(0.8, 1.8)
    matrix = cv2.getRotationMatrix2D((mask.shape[1] / 2, mask.shape[0] / 2), turn, zoom)
    matrix[:, 2] += np.array([side, side]) / 2 - np.array([mask.shape[1], mask.shape[0]]) / 2
    matrix[:, 2] += rng.uniform(-0.2, 0.2, 2) * side
    border = cv2.BORDER_REFLECT_101
    turned = cv2.warpAffine(picture, matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=border)
    inside = cv2.warpAffine(
        mask.astype(np.uint8), matrix, (side, side), flags=cv2.INTER_NEAREST, borderMode=border
    ).astype(bool)
    field = turned.astype(np.float32)
    steel = field.mean(axis=2, keepdims=True) * rng.uniform(0.3, 1.3) + rng.uniform(-25, 40)
    steel = steel * rng.uniform(0.92, 1.08, 3)
    field = field * rng.uniform(0.75, 1.2, 3) + rng.uniform(-15, 15)
    if rng.random() < 0.7:
        field = np.where(inside[..., None], steel, field)
    if rng.random() < 0.3:
        field = cv2.GaussianBlur(field, (0, 0), rng.uniform(0.5, 2.0))
    field = field + rng.normal(0, rng.uniform(0, 6), field.shape)
    return np.clip(field, 0, 255).astype(np.uint8), inside


def _loss(logits: Tensor, masks: Tensor) -> Tensor:
    """Cross-entropy plus one minus the soft Dice overlap."""
    share = torch.sigmoid(logits)
    overlap = 2 * (share * masks).sum() / ((share + masks).sum() + 1)
    return F.binary_cross_entropy_with_logits(logits, masks) + 1 - overlap


def _overlap(net: toolnet.ToolNet, picture: Picture, mask: Flags) -> float:
    found = toolnet.probability(net, picture) > 0.5
    either = np.count_nonzero(found | mask)
    return 1.0 if either == 0 else np.count_nonzero(found & mask) / either


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="rendered dataset with tools in view")
    parser.add_argument("-o", "--out", type=Path, default=toolnet.WEIGHTS.parent)
    parser.add_argument("--steps", type=int, default=450)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(json.dumps(train(given.data, given.out, given.steps, given.seed)))


if __name__ == "__main__":
    main()
