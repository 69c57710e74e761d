"""Can a small network tell crops of renderings from a photograph's? Held out by region and sequence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
import typer
from torch import nn

from evidence.look import crops as cutting
from evidence.look import cues
from evidence.measuring import measuring
from evidence.render.realism import OUTLINE

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Picture = npt.NDArray[np.uint8]

_FOLDS = 5
_BATCH, _RATE, _WIDTH = 32, 2e-3, 16
_BLOCKS = 40  # patches of the photograph that the control gives one label each
_BLURRED_PX = 3.0
_LINEAR_SHUFFLES = 200


@measuring("cortex.jpg", file="classifier.json", out="docs/results/render/look")
def classifier(
    photo: Annotated[Path, typer.Argument(help="A photograph of an exposed cortex.")],
    look: Annotated[
        list[Path] | None, typer.Option(help="Also a job, as synth fit writes it; repeat for more.")
    ] = None,
    outline: Annotated[
        str, typer.Option(help="Polygon of the cortex in it, as shares: x,y x,y ...")
    ] = OUTLINE,
    width_mm: Annotated[float, typer.Option(help="What the photograph's width spans.")] = 110.0,
    frames: Annotated[int, typer.Option(min=5, help="Rendered sequences, one frame of each.")] = 5,
    epochs: Annotated[int, typer.Option(min=1, help="Of training, a fold.")] = 10,
    shuffles: Annotated[
        int, typer.Option(min=1, help="Times that labels are shuffled, for the control.")
    ] = 5,
    seed: Annotated[int, typer.Option(help="Of the rendered jobs and the training.")] = 31,
    cache: Annotated[Path | None, typer.Option(help="Folder that keeps rendered crops.")] = None,
) -> dict[str, Any]:
    """AUC of a patch classifier, photograph against rendered crops; two controls have to be near 0.5."""
    torch.set_num_threads(1)
    theirs = cutting.of_photograph(photo, outline, width_mm, cutting.MM_PER_PX)
    region = cutting.regions(theirs.places, _FOLDS)
    names, own = cues.table(theirs.pictures)
    rng = np.random.default_rng(seed)
    rows, alone, told = [], {}, []
    jobs = cutting.name_jobs(look)
    for name, file in jobs:
        ours = cutting.kept_of_job(cutting.read_job(file, frames, seed, width_mm), cutting.MM_PER_PX, cache)
        both = Split.of(theirs, ours, region)
        # What of it gives crops away is asked of the last look, the one that is fitted.
        asked = parts(both.pictures) if file is jobs[-1][1] else {"everything": both.pictures}
        for part, pictures in asked.items():
            rows.append({"crops": name, "of": part, **held_out(pictures, both, epochs, seed)})
        figures = np.concatenate([own, cues.table(ours.pictures)[1]])
        alone[name] = figures
        told.append({"crops": name, "auc": round(cues.linear(figures, both.label, both.fold, both.near), 3)})
        if file is None:
            mixed = [both.shuffled(rng) for _ in range(_LINEAR_SHUFFLES)]
            found = [cues.linear(figures, one.label, one.fold, one.near) for one in mixed]
            told.append(_spread("control: shuffled labels", found))
            deep = [held_out(one.pictures, one, epochs, seed)["auc"] for one in mixed[:shuffles]]
            rows.append(
                {"of": "everything", "count": len(both.label), **_spread("control: shuffled labels", deep)}
            )
    itself = Split(
        theirs.pictures, block_labels(theirs.places, rng), region, cutting.overlapping(theirs.places)
    )
    rows.append({"crops": "control: photograph, itself", **held_out(itself.pictures, itself, epochs, seed)})
    return {
        "side_px": cutting.SIDE_PX,
        "mm_per_px": cutting.MM_PER_PX,
        "epochs": epochs,
        "rows": rows,
        "linear": told,
        "cues": tell_apart(names, len(own), alone),
    }


@dataclass(frozen=True)
class Split:
    """Crops with what is to be told of them and what may be learned from."""

    pictures: Picture
    """(N, n, n, 3) sRGB."""
    label: Ints
    """(N,) 0 or 1."""
    fold: Ints
    """(N,)"""
    near: npt.NDArray[np.bool_]
    """(N, N) crops that show some of the same: of different folds, neither is trained on for the other."""

    @classmethod
    def of(cls, theirs: cutting.Crops, ours: cutting.Crops, region: Ints) -> Split:
        """A photograph's crops, label 0, by region, and rendered ones, label 1, by sequence."""
        counts = len(theirs.pictures), len(ours.pictures)
        near = np.zeros((sum(counts), sum(counts)), bool)
        near[: counts[0], : counts[0]] = cutting.overlapping(theirs.places)
        fold = np.concatenate([region, ours.places[:, 0].astype(np.int64) % _FOLDS])
        return cls(np.concatenate([theirs.pictures, ours.pictures]), np.repeat([0, 1], counts), fold, near)

    def shuffled(self, rng: np.random.Generator) -> Split:
        """The same with each fold's labels dealt out anew, so that no fold's tell of another's."""
        label = self.label.copy()
        for k in np.unique(self.fold):
            label[self.fold == k] = rng.permutation(label[self.fold == k])
        return replace(self, label=label)


def parts(pictures: Picture) -> dict[str, Picture]:
    """Crops whole, without their colours, and without what is finer than a blur."""
    grey = np.stack([cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in pictures])
    return {
        "everything": pictures,
        "grey levels": np.repeat(grey[..., None], 3, axis=3),
        "colours, blurred": np.stack([cv2.GaussianBlur(one, (0, 0), _BLURRED_PX) for one in pictures]),
    }


def held_out(pictures: Picture, split: Split, epochs: int, seed: int) -> dict[str, Any]:
    """AUC of each fold on crops of it; none that shows some of them, their region or sequence was trained on.

    Args:
        pictures: (N, n, n, 3) sRGB, the split's or what is left of them.
        split: labels and folds.
        epochs: of training.
        seed: of weights, order and turns.
    """
    found = []
    for k in np.unique(split.fold):
        inside = split.fold == k
        taught = ~inside & ~split.near[inside].any(axis=0)
        if len(np.unique(split.label[inside])) < 2 or len(np.unique(split.label[taught])) < 2:
            continue
        net = _trained(pictures[taught], split.label[taught], epochs, seed + int(k))
        found.append(cues.auc(_scores(net, pictures[inside]), split.label[inside]))
    return {
        "count": len(split.label),
        "auc": round(float(np.mean(found)), 3),
        "lowest": round(min(found), 3),
        "highest": round(max(found), 3),
    }


def tell_apart(names: list[str], theirs: int, figures: dict[str, Floats]) -> list[dict[str, Any]]:
    """A row for each single figure: median of the photograph's crops, and of each job's with its AUC.

    Args:
        names: (C) of the figures.
        theirs: crops of the photograph, which come first.
        figures: (N, C) by name of the job.
    """
    rows = []
    for k, cue in enumerate(names):
        row: dict[str, Any] = {"cue": cue}
        for job, all_of_it in figures.items():
            label = (np.arange(len(all_of_it)) >= theirs).astype(np.int64)
            row["photograph"] = float(f"{np.median(all_of_it[:theirs, k]):.3g}")
            row[f"{job}, median"] = float(f"{np.median(all_of_it[theirs:, k]):.3g}")
            row[f"{job}, auc"] = round(cues.auc(all_of_it[:, k], label), 2)
        rows.append(row)
    last = f"{list(figures)[-1]}, auc"
    return sorted(rows, key=lambda row: -abs(row[last] - 0.5))


def block_labels(places: Floats, rng: np.random.Generator) -> Ints:
    """A label (N,) for each crop, the same for all of a patch: overlapping ones can't tell on each other."""
    from scipy.cluster.vq import kmeans2

    _, patch = kmeans2(places, _BLOCKS, minit="++", rng=rng)
    return np.asarray(rng.permutation(np.arange(_BLOCKS) % 2)[patch], np.int64)


def _spread(name: str, found: list[float]) -> dict[str, Any]:
    """Mean, spread and ends of some runs' AUC."""
    return {
        "crops": name,
        "auc": round(float(np.mean(found)), 3),
        "lowest": round(min(found), 3),
        "highest": round(max(found), 3),
        "runs": len(found),
        "sd": round(float(np.std(found)), 3),
    }


class _Net(nn.Sequential):
    """Four strided convolutions and the mean over the crop."""

    def __init__(self) -> None:
        layers: list[nn.Module] = []
        for k, (a, b) in enumerate(((3, 1), (1, 2), (2, 3), (3, 4))):
            before = 3 if k == 0 else a * _WIDTH
            layers += [nn.Conv2d(before, b * _WIDTH, 3, 2, 1), nn.BatchNorm2d(b * _WIDTH), nn.ReLU()]
        super().__init__(
            *layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Dropout(0.3), nn.Linear(4 * _WIDTH, 1)
        )


def _trained(pictures: Picture, label: Ints, epochs: int, seed: int) -> nn.Module:
    """The network after training on turned and mirrored crops, both labels counting as much."""
    order = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        net = _Net()
        data, truth = _tensor(pictures), torch.from_numpy(label).float()
        weight = torch.tensor(float((label == 0).sum() / max((label == 1).sum(), 1)))
        optimiser = torch.optim.AdamW(net.parameters(), _RATE, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
        net.train()
        for _ in range(epochs):
            for part in torch.split(torch.randperm(len(data), generator=order), _BATCH):
                if len(part) < 2:
                    continue
                turn, mirror = (
                    torch.randint(4, (1,), generator=order),
                    torch.randint(2, (1,), generator=order),
                )
                batch = torch.rot90(data[part], int(turn), (2, 3))
                batch = batch.flip(3) if mirror else batch
                optimiser.zero_grad()
                said = net(batch)[:, 0]
                nn.functional.binary_cross_entropy_with_logits(
                    said, truth[part], pos_weight=weight
                ).backward()  # type: ignore[no-untyped-call]
                optimiser.step()
            schedule.step()
    return net.eval()


def _scores(net: nn.Module, pictures: Picture) -> Floats:
    with torch.no_grad():
        return np.asarray(
            torch.cat([net(part)[:, 0] for part in torch.split(_tensor(pictures), 64)]).double().numpy()
        )


def _tensor(pictures: Picture) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).float() / 127.5 - 1
