"""Training with AdamW or in closed form; every epoch is checkpointed, and a run resumes bit for bit."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensorboardX import SummaryWriter
from torch.optim import AdamW
from torch.optim.lr_scheduler import ReduceLROnPlateau

from learn import checkpoint
from learn.checkpoint import USED, ModelCard
from learn.data.clips import RECOVERED, Clip, scored_source
from learn.data.grid import Scales
from learn.evaluation.metrics import agreement, moments
from learn.inference.convert import add_onnx
from learn.loss import is_full, loss
from learn.network.registry import build, load_network
from learn.settings import TrainingSettings, replace
from learn.split import Split, find_unit, name_parts
from learn.training.batches import Batch, FrameDataset, add_surface_motion, inputs, measure_scales
from synth.arrays import Floats
from synth.errors import UserError, as_user_error
from synth.system.terminal import ProgressCallback

CLIP = 1.0  # largest norm of the gradient
WEIGHT_DECAY = 1e-5
PATIENCE = 5  # `plateau`: epochs without a better score after which the learning rate is halved
CHECK_EVERY = 16  # steps between two checks of the loss, each of which makes a GPU wait
_GAIN_ANATOMIES = 8  # least number of anatomies that a force gain is fitted on
_GAINS = 0.67, 1.5  # limits of the gain: a larger correction would hide that a network has not learnt


def train(
    clips: Sequence[Clip],
    split: Split,
    settings: TrainingSettings,
    out: Path,
    *,
    report: ProgressCallback = lambda done, of: None,
    device: torch.device | str = "cpu",
    start: tuple[torch.nn.Module, ModelCard] | None = None,
    log: Callable[[dict[str, float]], None] = lambda numbers: None,
) -> ModelCard:
    """Trains on `split.fit` and scores on `split.select`; `split.test` is not used.

    An unfinished run of the same settings and data in `out` is continued, with the result (bit for bit on one
    CPU) of an uninterrupted run. `start`: a model whose weights and scales training starts from; what it was
    trained on is the card's part `start`. `report` is called after a batch, `log` with an epoch's numbers.

    The stored epoch, the last with `cosine`, the best with `plateau`, is also written as ONNX, by which it is
    used. Returns its card. Raises UserError if
    `out` holds another run, on divergence, and for a `start` that `_begin_card` refuses.
    """
    fit, select = [clips[i] for i in split.fit], [clips[i] for i in split.select]
    scales = start[1].scales if start else measure_scales(fit, settings)
    typical_young = float(np.exp(np.mean([np.log(clip.young_kpa) for clip in fit])))
    source = scored_source(settings.input)
    recovered = (clip.recovered_by for clip in fit if source in RECOVERED and source in clip.displacement)
    motion = sorted({*recovered} - {""})
    parts = name_parts(clips, split)
    card = ModelCard(settings, scales, typical_young, *parts, [*split.hashes], motion=motion)
    card = _begin_card(card, start[1]) if start else card
    state = _open(out, card)
    try:
        run = _start(card, state, torch.device(device), start and start[0])
        frames, chooser = (FrameDataset(part, settings, torch.device(device)) for part in (fit, select))
        # Events after the epoch that a run is continued from are dropped.
        with SummaryWriter(str(out / "tensorboard"), purge_step=run.epoch) as board:
            for epoch in range(run.epoch, settings.epochs):
                numbers = _epoch(run.model, run.optimizer, frames, scales, epoch, report)
                numbers |= select_score(run.model, chooser, scales)
                improved = run.end_epoch(numbers["select_r2"], settings)
                numbers |= {"epoch": epoch + 1.0, "lr": run.optimizer.param_groups[0]["lr"]}
                _write_numbers(out / "history.jsonl", board, epoch, numbers)
                if improved:
                    gain = numbers["select_gain"]
                    epoch_card = dataclasses.replace(card, epoch=run.epoch, score=run.best, force_gain=gain)
                    checkpoint.write_model(out, epoch_card, _cpu(run.model.state_dict()))
                checkpoint.save_tensors(out / "last.pt", run.as_dict())
                log(numbers)
    except (UserError, OSError):
        # A new run without a checkpoint, on a full disk for instance, leaves no folder.
        if state is None and not (out / "last.pt").exists():
            shutil.rmtree(out)
        raise
    if (card := checkpoint.read_card(out)).weights_hash and not card.onnx_hash:
        card = add_onnx(out)
    return card


def _begin_card(card: ModelCard, start: ModelCard) -> ModelCard:
    """The card of a training that begins with the weights of a model with the card `start`.

    UserError if that is of another architecture, grid or unit of the split, or was trained on brains of the
    select, interval or test part.
    """
    shapes = [
        (settings.network, settings.arch.model_dump(exclude={"dropout"}), settings.grid)
        for settings in (card.settings, start.settings)
    ]
    if shapes[0] != shapes[1]:
        raise UserError("start: a model of another architecture or grid")
    if find_unit(card) != find_unit(start):
        raise UserError("start: its data were split by another unit (anatomy, opening or sequence)")
    for start_parts, new_parts in ((start.split, card.split), (start.groups, card.groups)):
        barred_parts = {"select": ("fit", "start"), "intervals": ("fit", "select", "start"), "test": USED}
        for part, used_parts in barred_parts.items():
            if {group for name in used_parts for group in start_parts.get(name, ())}.intersection(
                new_parts.get(part, ())
            ):
                raise UserError(f"start: was trained on brains of this data's {part} part")
        new_parts["start"] = sorted({group for name in USED for group in start_parts.get(name, ())})
    return dataclasses.replace(card, motion=sorted({*card.motion, *start.motion}))


def _write_numbers(file: Path, board: SummaryWriter, epoch: int, numbers: dict[str, float]) -> None:
    """Writes the numbers of epoch `epoch`, counted from 0, as a line of JSON and as TensorBoard events."""
    lines = file.read_text().splitlines()[:epoch] if file.exists() else []
    file.write_text("\n".join([*lines, json.dumps(numbers)]) + "\n")
    for name, value in numbers.items():
        board.add_scalar(name.replace("_", "/", 1), value, epoch)
    board.flush()


@dataclasses.dataclass
class _Run:
    """State of a run between two epochs, from which it can be continued."""

    model: torch.nn.Module
    optimizer: Any
    plateau: ReduceLROnPlateau
    epoch: int = 0  # epochs done
    best: float = -math.inf  # R² on the select sequences of the stored epoch

    def end_epoch(self, score: float, settings: TrainingSettings) -> bool:
        """Updates the state by an epoch's score; returns whether the epoch is to be stored."""
        self.epoch += 1
        if settings.schedule == "plateau":
            self.plateau.step(score)
        # No epoch before the loss has its full penalty on off-target force. With `cosine` the last one: the
        # best on the select side erred half as much again on other mechanics (design.md).
        is_better = score > (-math.inf if settings.schedule == "cosine" else self.best)
        improved = is_full(settings.loss, self.epoch / settings.epochs) and is_better
        self.best = score if improved else self.best
        return improved

    def as_dict(self) -> dict[str, Any]:
        moving = {"optimizer": self.optimizer.state_dict(), "plateau": self.plateau.state_dict()}
        return {"epoch": self.epoch, "best": self.best, "model": _cpu(self.model.state_dict()), **moving}


def _start(
    card: ModelCard, state: dict[str, Any] | None, device: torch.device, start: torch.nn.Module | None
) -> _Run:
    """A new run, from the weights of `start` if given, or one continued from a state of `_Run.as_dict`."""
    settings = card.settings
    torch.manual_seed(settings.seed)
    model = build(settings.network, settings.arch)
    if start is not None:
        model.load_state_dict(start.state_dict())
    model = model.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    # `fused` saves a fifth of a small network's training time on a CPU.
    optimizer = AdamW(model.parameters(), lr=settings.learning_rate, weight_decay=WEIGHT_DECAY, fused=True)
    plateau = ReduceLROnPlateau(optimizer, mode="max", factor=0.5, patience=PATIENCE)
    run = _Run(model, optimizer, plateau)
    if state is not None:
        with as_user_error("last.pt: corrupt checkpoint"):
            model.load_state_dict(state["model"])
            optimizer.load_state_dict(state["optimizer"])
            plateau.load_state_dict(state["plateau"])
            run.epoch, run.best = int(state["epoch"]), float(state["best"])
    return run


def _epoch(
    net: torch.nn.Module,
    optimizer: Any,
    frames: FrameDataset,
    scales: Scales,
    epoch: int,
    report: ProgressCallback,
) -> dict[str, float]:
    settings = frames.settings
    # Seeds depend on (seed, epoch) alone, so a resumed run draws as an uninterrupted one.
    seed = np.random.SeedSequence([settings.seed, epoch])
    torch.manual_seed(int(seed.generate_state(1)[0]))
    order = frames.order(np.random.default_rng(seed))
    batches = max(len(order) // settings.batch, 1)
    if (solve := load_network(settings.network).solve) is not None:
        parts = (order[i * settings.batch : (i + 1) * settings.batch] for i in range(batches))
        augmented = (_augment(frames.batch(part), settings, epoch, i) for i, part in enumerate(parts))
        solve(net, ((inputs(batch, settings, scales), batch.target / scales.target) for batch in augmented))
    net.train(solve is None)
    total = torch.zeros((), device=frames.device)
    constants = scales.target, scales.spread, scales.force / settings.grid.pitch_mm**2
    for i in range(batches):
        part = order[i * settings.batch : (i + 1) * settings.batch]
        batch = _augment(frames.batch(part), settings, epoch, i)
        with torch.set_grad_enabled(solve is None):
            predicted = forward(net, batch, settings, scales)
        progress = (epoch + i / batches) / settings.epochs
        error = loss(predicted, batch.target, batch.mask, settings.loss, *constants, progress)
        if i % CHECK_EVERY == 0:
            _finite(float(error.detach()), epoch)
        if solve is None:
            if settings.schedule == "cosine":
                for group in optimizer.param_groups:
                    group["lr"] = settings.learning_rate * cosine(progress)
            optimizer.zero_grad()
            error.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(net.parameters(), CLIP)
            optimizer.step()
        total += error.detach()
        report(epoch * batches + i + 1, settings.epochs * batches)
    return {"loss": _finite(float(total) / batches, epoch)}


def _augment(batch: Batch, settings: TrainingSettings, epoch: int, number: int) -> Batch:
    """A batch of an epoch with the settings' motion of the surface."""
    if settings.surface_motion_mm <= 0:
        return batch
    draws = np.random.SeedSequence([settings.seed, epoch, number])
    rng = torch.Generator().manual_seed(int(draws.generate_state(1)[0]))
    return add_surface_motion(batch, settings, rng)


def _finite(value: float, epoch: int) -> float:
    if not math.isfinite(value):
        raise UserError(f"training diverged in epoch {epoch + 1}: lower learning_rate")
    return value


def cosine(progress: float, warm: float = 0.05) -> float:
    """Factor on the learning rate at a point 0..1 of the run: linear warm-up, then half a cosine to zero."""
    if progress < warm:
        return (progress + 1e-3) / (warm + 1e-3)
    return 0.5 * (1 + math.cos(math.pi * (progress - warm) / (1 - warm)))


def forward(net: Any, batch: Batch, settings: TrainingSettings, scales: Scales) -> torch.Tensor:
    """The network's map in physical units per unit stiffness: (B, C, N, N), unit of `Scales.target`."""
    x = inputs(batch, settings, scales).contiguous(memory_format=torch.channels_last)
    with torch.autocast(x.device.type, torch.bfloat16, enabled=settings.precision == "bf16-mixed"):
        predicted: torch.Tensor = net(x)
    return predicted.float() * scales.target


@torch.no_grad()
def select_score(net: torch.nn.Module, frames: FrameDataset, scales: Scales) -> dict[str, float]:
    """R² and RMSE over all tissue cells and components, on the input kind's last source, and the gain that
    corrects the underestimate of force by noise and the penalty on off-target force."""
    net.eval()
    sums, forces = np.zeros(7), list[tuple[Floats, Floats]]()
    for c in range(len(frames.clips)):
        true, predicted = list[Floats](), list[Floats]()
        for batch in frames.sequential(c, frames.sources[-1]):
            inside = batch.mask.bool().expand_as(batch.target)
            pair = batch.target, forward(net, batch, frames.settings, scales)
            sums = sums + moments(*(maps[inside].cpu().numpy() for maps in pair))
            for totals, maps in zip((true, predicted), pair, strict=True):
                totals.append((maps * inside).sum((2, 3)).cpu().double().numpy())
        forces.append((np.concatenate(true), np.concatenate(predicted)))
    result = agreement(sums)
    return {
        "select_r2": result["r2"] if math.isfinite(result["r2"]) else -math.inf,
        "select_rmse": result["rmse"],
        "select_gain": _gain(forces, len({clip.group for clip in frames.clips})),
    }


def _gain(forces: Sequence[tuple[Floats, Floats]], anatomies: int) -> float:
    """The factor on predicted forces with the least mean absolute error over each sequence's mean force,
    within `_GAINS`; 1 for too few anatomies.

    `forces`: true and predicted ones, each (T, C), of each sequence. A least-squares slope would be set by
    the strongest sequence alone, as loads span decades.
    """
    ratios, weights = [], []
    for true, predicted in forces:
        size, mean = np.linalg.norm(predicted, axis=1), np.linalg.norm(true, axis=1).sum()
        is_nonzero = size > 0
        if mean > 0 and is_nonzero.any():
            ratios.append(((true * predicted).sum(1)[is_nonzero]) / size[is_nonzero] ** 2)
            weights.append(size[is_nonzero] / mean)
    if anatomies < _GAIN_ANATOMIES or not ratios:
        return 1.0
    ratio, weight = np.concatenate(ratios), np.concatenate(weights)
    median = float(np.quantile(ratio, 0.5, weights=weight, method="inverted_cdf"))
    return min(max(median, _GAINS[0]), _GAINS[1])


def _open(out: Path, card: ModelCard) -> dict[str, Any] | None:
    """The state to continue from, or None for a new run in a new folder."""
    # An interrupted write of the first card leaves a hidden file.
    if not out.exists() or (out.is_dir() and all(path.name.startswith(".") for path in out.iterdir())):
        checkpoint.write_card(out, card)
        return None
    stored = checkpoint.read_card(out)
    if stored.settings != replace(card.settings, epochs=stored.settings.epochs):
        raise UserError(f"{out}: holds a model trained with other settings; choose another folder")
    if stored.split != card.split or stored.scales != card.scales:
        raise UserError(f"{out}: holds a model trained on other data; choose another folder")
    is_schedule_fixed = not is_full(stored.settings.loss, 0.0) or stored.settings.schedule == "cosine"
    if stored.settings.epochs != card.settings.epochs and is_schedule_fixed:
        raise UserError(f"{out}: its schedule is for {stored.settings.epochs} epochs; don't change --epochs")
    return checkpoint.read_tensors(out / "last.pt") if (out / "last.pt").exists() else None


def _cpu(state: dict[str, Any]) -> dict[str, Any]:
    return {k: v.detach().cpu().clone() for k, v in state.items()}
