"""Can a small network tell crops of renderings from a photograph's? Held out by region and sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch
import typer
from scipy.stats import rankdata
from torch import nn

from evidence.look import crops as cutting
from evidence.measuring import measuring
from evidence.render.realism import OUTLINE

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_FOLDS = 5
_BATCH, _RATE, _WIDTH = 32, 2e-3, 16
_BLOCKS = 40  # patches of the photograph that the control gives one label each


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
    seed: Annotated[int, typer.Option(help="Of the rendered jobs and the training.")] = 31,
    cache: Annotated[Path | None, typer.Option(help="Folder that keeps rendered crops.")] = None,
) -> dict[str, Any]:
    """AUC of a patch classifier, photograph against rendered crops; two controls have to be near 0.5."""
    torch.set_num_threads(1)
    theirs = cutting.of_photograph(photo, outline, width_mm, cutting.MM_PER_PX)
    region = cutting.regions(theirs.places, _FOLDS)
    rng = np.random.default_rng(seed)
    rows = []
    for name, file in cutting.name_jobs(look):
        ours = cutting.kept_of_job(cutting.read_job(file, frames, seed), cutting.MM_PER_PX, cache)
        pictures = np.concatenate([theirs.pictures, ours.pictures])
        label = np.repeat([0, 1], [len(theirs.pictures), len(ours.pictures)])
        fold = np.concatenate([region, ours.places[:, 0].astype(np.int64) % _FOLDS])
        rows.append({"crops": name, **held_out(pictures, label, fold, epochs, seed)})
        if file is None:
            mixed = rng.permutation(label)
            rows.append(
                {"crops": "control: shuffled labels", **held_out(pictures, mixed, fold, epochs, seed)}
            )
    label = block_labels(theirs.places, rng)
    rows.append(
        {"crops": "control: photograph, itself", **held_out(theirs.pictures, label, region, epochs, seed)}
    )
    return {"side_px": cutting.SIDE_PX, "mm_per_px": cutting.MM_PER_PX, "epochs": epochs, "rows": rows}


def held_out(
    pictures: npt.NDArray[np.uint8], label: Ints, fold: Ints, epochs: int, seed: int
) -> dict[str, Any]:
    """AUC of each fold on crops of it that no crop of its region or sequence was trained on.

    Args:
        pictures: (N, n, n, 3) sRGB.
        label: (N,) 0 or 1.
        fold: (N,).
        epochs: of training.
        seed: of weights, order and turns.
    """
    found = []
    for k in np.unique(fold):
        inside = fold == k
        if len(np.unique(label[inside])) < 2:
            continue
        net = _trained(pictures[~inside], label[~inside], epochs, seed + int(k))
        found.append(auc(_scores(net, pictures[inside]), label[inside]))
    return {
        "count": len(label),
        "auc": round(float(np.mean(found)), 3),
        "lowest": round(min(found), 3),
        "highest": round(max(found), 3),
    }


def auc(score: Floats, label: Ints) -> float:
    """Chance that a crop of label 1 scores above one of label 0; ties count half (Mann and Whitney, 1947)."""
    ones = label == 1
    n, m = int(ones.sum()), int((~ones).sum())
    return float((rankdata(score)[ones].sum() - n * (n + 1) / 2) / (n * m))


def block_labels(places: Floats, rng: np.random.Generator) -> Ints:
    """A label (N,) for each crop, the same for all of a patch: overlapping ones can't tell on each other."""
    from scipy.cluster.vq import kmeans2

    _, patch = kmeans2(places, _BLOCKS, minit="++", rng=rng)
    return np.asarray(rng.permutation(np.arange(_BLOCKS) % 2)[patch], np.int64)


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


def _trained(pictures: npt.NDArray[np.uint8], label: Ints, epochs: int, seed: int) -> nn.Module:
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


def _scores(net: nn.Module, pictures: npt.NDArray[np.uint8]) -> Floats:
    with torch.no_grad():
        return np.asarray(
            torch.cat([net(part)[:, 0] for part in torch.split(_tensor(pictures), 64)]).double().numpy()
        )


def _tensor(pictures: npt.NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).float() / 127.5 - 1
