"""Trains the tool mask's U-Net on frames rendered for it, with exact masks of the instrument.

Appearance, view, instruments and their poses are random; the tissue is at rest, without physics, which takes
a fifth of the time of a sequence's frame.
Writes `toolnet.pt` (half precision) and `toolnet.json` (command, seed, steps, and the overlap on held-out
scenes of the network and of the rule without weights).
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from evidence import training
from evidence.study import Study
from synth.arrays import Floats, Mask, Pixels
from synth.flow import mask_detection, toolnet
from synth.job.schema import Job
from synth.render.scene import SceneState
from synth.sequence import scenario
from synth.sequence.scene import at_rest
from synth.tune.search import changed

Frame = tuple[Pixels, Mask]  # an image (H, W, 3) sRGB and its instrument mask (H, W)
FRAMES = 6  # frames a scene; the last shows no instrument
_FAMILIES = ("healthy", "pale", "hyperaemic", "oedematous", "calf")
_GESTURES = ("pull", "push", "slide", "retract")  # together they use every instrument
_AWAY_MM = 300.0  # outside every view
_HELD_OUT, _FIRST = range(13), 26  # scenes to test on, and the first to train on
_BATCH, _RATE = 8, 3e-3


def frames_of(scenes: range, seed: int) -> Iterator[Frame]:
    """`FRAMES` frames of each scene; scenes differ in anatomy, appearance, view, instrument and poses."""
    job = Job.model_validate(
        {
            "seed": seed,
            "sequences": scenes.stop,
            "frames": FRAMES,
            "anatomy": {"vertices": 12000},
            "appearance": {"families": _FAMILIES},
            "light": {"glare": (0.0, 0.8)},
            "render": {"size": (320, 240), "field_mm": (22, 38), "spp": 4},
        }
    )
    for index in scenes:
        yield from _scene(job, index)


def _scene(job: Job, index: int) -> Iterator[Frame]:
    rng = np.random.default_rng([job.seed, index])
    hands = [str(kind) for kind in rng.choice(_GESTURES, size=1 + (rng.random() < 0.2))]
    scene = at_rest(changed(job, {"fem.instrument_list": [{"gesture": kind} for kind in hands]}), index)
    vertices = scene.surface.vertices
    for k, seed in enumerate(scenario.frame_seeds(job, index)):
        poses = [_pose(vertices, job.anatomy.craniotomy.radius_mm, rng) for _ in hands]
        tips, shafts = np.concatenate([p[0] for p in poses]), np.concatenate([p[1] for p in poses])
        if k == FRAMES - 1:
            tips = tips + np.array([0.0, 0.0, _AWAY_MM])
        shot = scene.renderer.render(SceneState(vertices, tips, shafts), seed)
        yield shot.rgb, shot.tool


def _pose(vertices: Floats, radius_mm: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """An instrument's two tips (2, 3) mm over the opening, and directions of its shafts (2, 3)."""
    around, far = rng.uniform(0, 2 * np.pi), 0.95 * radius_mm * np.sqrt(rng.uniform())
    over = far * np.array([np.cos(around), np.sin(around)])
    near = vertices[np.argmin(np.linalg.norm(vertices[:, :2] - over, axis=1))]
    azimuth, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(30, 70))
    shaft = np.array([np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)])
    side = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    tip = near + max(0.0, rng.uniform(-6, 12)) * shaft  # in contact a third of the time
    spread = rng.uniform(0.3, 9.0)
    return tip + np.array([[0.5], [-0.5]]) * spread * side, np.stack([shaft, shaft])


def measure(out: Path = toolnet.WEIGHTS.parent, scenes: int = 39, steps: int = 700, seed: int = 0) -> None:
    """Renders `scenes` scenes, trains for `steps` steps of AdamW, writes weights and card."""
    rendered = list(frames_of(range(_FIRST, _FIRST + scenes), seed))
    net = fit(rendered, steps, seed)
    held = list(frames_of(_HELD_OUT, seed))
    card = {
        "frames": len(rendered),
        "held_out_frames": len(held),
        "held_out_iou": overlap(held, lambda rgb: toolnet.probability(net, rgb) > 0.5),
        "held_out_iou_with_the_rule": overlap(held, lambda rgb: mask_detection.both(rgb, net)),
        "held_out_iou_of_the_rule": overlap(held, mask_detection.grey_bodies),
    }
    training.export(net, out / "toolnet.pt", card)


def fit(frames: Sequence[Frame], steps: int, seed: int) -> toolnet.ToolNet:
    """A network trained from random weights; one-cycle learning rate, one thread."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    net = toolnet.ToolNet()
    optimiser = torch.optim.AdamW(net.parameters(), _RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=steps)
    net.train()
    for _ in range(steps):
        chosen = [_vary(*frames[int(k)], rng) for k in rng.integers(len(frames), size=_BATCH)]
        pictures = torch.from_numpy(np.stack([toolnet.prepare(picture) for picture, _ in chosen]))
        masks = torch.from_numpy(np.stack([mask for _, mask in chosen]))[:, None].float()
        small = F.interpolate(masks, size=(toolnet.SIDE, toolnet.SIDE), mode="area")
        loss = _loss(net(pictures), F.avg_pool2d(small, 2))
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    return net.eval()


def overlap(frames: Sequence[Frame], find: Callable[[Pixels], Mask]) -> float:
    """Intersection over union of detected and true tool pixels, pooled over all frames."""
    both = either = 0
    for rgb, tool in frames:
        found = find(rgb)
        both += int(np.count_nonzero(found & tool))
        either += int(np.count_nonzero(found | tool))
    return both / max(either, 1)


def _vary(picture: Pixels, mask: Mask, rng: np.random.Generator) -> tuple[Pixels, Mask]:
    """Random rotation, zoom and square crop, and changes of light, steel and colour."""
    side = min(mask.shape)
    turn, zoom = rng.uniform(0, 360), rng.uniform(0.55, 1.3)
    middle = np.array([mask.shape[1], mask.shape[0]]) / 2
    matrix = cv2.getRotationMatrix2D(tuple(middle.tolist()), turn, zoom)
    matrix[:, 2] += side / 2 - middle
    matrix[:, 2] += rng.uniform(-0.2, 0.2, 2) * side
    border = cv2.BORDER_REFLECT_101
    turned = cv2.warpAffine(picture, matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=border)
    tool = mask.astype(np.uint8)
    inside = cv2.warpAffine(tool, matrix, (side, side), flags=cv2.INTER_NEAREST, borderMode=border) > 0
    field = turned.astype(np.float32)
    if rng.random() < 0.5:  # another steel
        steel = field.mean(axis=2, keepdims=True) * rng.uniform(0.3, 1.5) + rng.uniform(-25, 60)
        field = np.where(inside[..., None], steel * rng.uniform(0.92, 1.08, 3), field)
    field = field * rng.uniform(0.8, 1.2, 3) + rng.uniform(-15, 15)
    field = 255 * np.clip(field / 255, 0, 1) ** rng.uniform(0.75, 1.35)
    if rng.random() < 0.3:
        field = cv2.GaussianBlur(field, (0, 0), rng.uniform(0.5, 1.5))
    field = field + rng.normal(0, rng.uniform(0, 6), field.shape)
    return np.clip(field, 0, 255).astype(np.uint8), inside


def _loss(logits: Tensor, masks: Tensor) -> Tensor:
    """Cross-entropy plus one minus the soft Dice overlap."""
    share = torch.sigmoid(logits)
    overlap = 2 * (share * masks).sum() / ((share + masks).sum() + 1)
    return F.binary_cross_entropy_with_logits(logits, masks) + 1 - overlap


STUDY = Study(measure, steps=())
