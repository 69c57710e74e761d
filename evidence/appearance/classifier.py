"""Held-out AUC of a small network that distinguishes crops of renderings from those of a photograph."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from sklearn.metrics import roc_auc_score
from torch import nn

from evidence import report, status
from evidence.flow.scenes import jpeg
from evidence.render.photograph import OUTLINE, bare_picture, corners, outlined, scaled_photograph
from evidence.study import Study
from synth.arrays import Floats, Ints, Mask, Pixels
from synth.errors import UserError
from synth.fit.fitting import fit_camera
from synth.fit.photograph import Photograph, read_photograph
from synth.job.schema import Job
from synth.tune.search import changed

SIDE_PX = 128
_NOISE, _QUALITY = 2.0, 90  # grey levels; of JPEG
MM_PER_PX = 0.0547  # of all crops
_FOLDS = 5
_HELD_OUT = (3, 4), (0, 1)  # pairs of sectors: the camera is fitted on the others and tested on these
_BATCH, _RATE, _WIDTH = 32, 2e-3, 16
_PATCHES = 40  # of the photograph; the control assigns one label to each
_BLURRED_PX = 3.0


def of_photograph(photo: Path, outline: str, width_mm: float, step: int = 56) -> tuple[Pixels, Floats]:
    """Crops (N, 128, 128, 3) of the photograph inside an outline, and their corners (N, 2) in it [px].

    Raises:
        UserError: the file is not an image, or no crop fits.
    """
    image = scaled_photograph(photo, width_mm / MM_PER_PX)
    found = corners(outlined(outline, image.shape[:2]), SIDE_PX, step)
    if not found:
        raise UserError(f"{photo}: no crop of {SIDE_PX} px fits inside the outline")
    return crops(taken(image, 0), found), np.array(found, float)


def of_job(job: Job, step: int = 64) -> tuple[Pixels, Ints]:
    """Crops of tissue in the first frame of each sequence, without instruments; and their sequence (N,)."""
    field = job.render.size[0] * MM_PER_PX
    # `taken` applies the codec.
    bare = changed(
        job, {"fem.instrument": "none", "render.field_mm": (field, field), "sensor.bitrate_mbps": None}
    )
    pictures, of = [], []
    for index in range(job.sequences):
        rgb, inside, _ = bare_picture(bare, index)
        found = corners(inside, SIDE_PX, step)
        pictures.append(crops(taken(rgb, index + 1), found))
        of += [index] * len(found)
    return np.concatenate(pictures), np.array(of)


def without(given: Photograph, places: Floats) -> Photograph:
    """The photograph with the pixels of some crops marked as unusable."""
    usable, scale = given.usable.copy(), MM_PER_PX / given.mm_per_px
    for x, y in places:
        rows, columns = (slice(int(scale * at), int(scale * (at + SIDE_PX)) + 1) for at in (y, x))
        usable[rows, columns] = False
    return given._replace(usable=usable)


def read_job(sections: dict[str, Any], frames: int, seed: int, width_mm: float) -> Job:
    """The job whose frames are compared: a default one with the sections fitted by `synth fit`.

    The fitted vignetting is that of the whole photograph, `width_mm` wide. These frames correspond to a piece
    of its centre, where vignetting is less by the square of the width.
    """
    job = Job.model_validate({"sequences": frames, "seed": seed, **sections})
    if not sections:
        return job
    share = min(1.0, job.render.size[0] * MM_PER_PX / width_mm)
    return changed(job, {"sensor.vignette": job.sensor.vignette * share**2})


def taken(rgb: Pixels, seed: int) -> Pixels:
    """The image with the noise and JPEG compression common to all crops."""
    noise = np.random.default_rng([seed, 5]).normal(0, _NOISE, rgb.shape)
    return jpeg(np.clip(rgb + noise, 0, 255).astype(np.uint8), _QUALITY)


def crops(rgb: Pixels, found: list[tuple[int, int]]) -> Pixels:
    """Square crops (N, 128, 128, 3) of a picture at some upper left corners (x, y)."""
    cut = [rgb[y : y + SIDE_PX, x : x + SIDE_PX] for x, y in found]
    return np.asarray(cut, np.uint8).reshape(-1, SIDE_PX, SIDE_PX, 3)


def measure(
    photo: Path,
    outline: str = OUTLINE,
    width_mm: float = 110.0,
    frames: int = 5,
    epochs: int = 8,
    seed: int = 31,
) -> dict[str, Any]:
    """AUC of a patch classifier, photograph against rendered crops; two controls should be near 0.5.

    Fitted cameras are tested on sectors that `synth fit` did not use. `outline`, `width_mm`: of the cortex in
    the photograph; `frames`: number of rendered sequences, one frame each.
    """
    (theirs, places), rng = of_photograph(photo, outline, width_mm), np.random.default_rng(seed)
    away = places - places.mean(axis=0)
    turn = np.arctan2(away[:, 1], away[:, 0])
    region = turn.argsort().argsort() * _FOLDS // len(turn)  # sectors about the centre, of equally many crops
    near = np.asarray((np.abs(places[:, None] - places[None]) < SIDE_PX).all(axis=2))  # overlapping
    rows = []

    def add(name: str, pictures: Pixels, label: Ints, fold: Ints, near: Mask) -> None:
        scores = held_out(pictures, label, fold, near, epochs, seed)
        rows.append({"crops": name, "count": len(label), **summary(list(scores.values()))})

    def against(job: Job) -> tuple[Pixels, Ints, Ints, Mask]:
        ours, sequence = of_job(job)
        label = np.repeat([0, 1], (len(theirs), len(ours)))
        fold, both = np.concatenate([region, sequence % _FOLDS]), np.pad(near, (0, len(ours)))
        return np.concatenate([theirs, ours]), label, fold, both

    pictures, label, fold, both = against(read_job({}, frames, seed, width_mm))
    for name, of in ablated(pictures).items():
        add(f"default job{name}", of, label, fold, both)
    for k in (1, 2, 3):
        add(f"control: labels shuffled, {k}", pictures, shuffled(label, fold, rng), fold, both)
    found: dict[str, list[float]] = {}
    fitted: list[dict[str, Any]] = []
    for pair in _HELD_OUT:
        usable = without(read_photograph(photo, width_mm, None), places[np.isin(region, pair)])
        fitted.append(fit_camera(usable))
        pictures, label, fold, both = against(read_job(fitted[-1], frames, seed, width_mm))
        for name, of in ablated(pictures).items():
            scores = held_out(of, label, fold, both, epochs, seed, pair)
            found.setdefault(f"fitted{name}", []).extend(scores.values())
    rows += [{"crops": name, "count": len(theirs), **summary(scores)} for name, scores in found.items()]
    add("control: photograph, itself", theirs, patch_labels(places, rng), region, near)
    return {"data": status.data(photo), "epochs": epochs, "fitted": fitted, "rows": rows}


def page(found: Mapping[str, Any]) -> report.Page:
    """Mean AUC of every set of crops, with the range over folds."""
    rows = found["rows"]
    bars = tuple(report.Row(row["crops"], row["auc"], tuple(row["ends"])) for row in rows)
    chart = report.Chart("1: separable, 0.5: not separable", "AUC, lowest to highest fold", bars)
    table = [
        {"crops": row["crops"], "count": row["count"], "AUC": report.mean_cell([row["auc"], *row["ends"]])}
        for row in rows
    ]
    words = (f"**AUC of the default job: {rows[0]['auc']:.2f}.** Mean and range over folds.",)
    return report.Page(
        "Rendered crops against a photograph's", found, [chart], [report.Section("", table)], words
    )


def ablated(pictures: Pixels) -> dict[str, Pixels]:
    """Crops (N, n, n, 3) as they are, without colour, and without fine structure, by name."""
    grey = np.stack([cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in pictures])
    blurred = np.stack([cv2.GaussianBlur(one, (0, 0), _BLURRED_PX) for one in pictures])
    return {"": pictures, ", grey levels": np.repeat(grey[..., None], 3, axis=3), ", blurred": blurred}


def shuffled(label: Ints, fold: Ints, rng: np.random.Generator) -> Ints:
    """Labels permuted within each fold, so that one fold's contain no information on another's."""
    label = label.copy()
    for k in np.unique(fold):
        label[fold == k] = rng.permutation(label[fold == k])
    return label


def patch_labels(places: Floats, rng: np.random.Generator) -> Ints:
    """A label (N,) for each crop, the same for all of a patch, so that overlapping crops agree."""
    _, patch = kmeans2(places, _PATCHES, minit="++", rng=rng)
    return np.asarray(rng.permutation(np.arange(_PATCHES) % 2)[patch], np.int64)


def summary(scores: list[float]) -> dict[str, Any]:
    """Mean and range of the AUC of some folds."""
    return {"auc": float(np.mean(scores)), "ends": (min(scores), max(scores))}


def held_out(
    pictures: Pixels,
    label: Ints,
    fold: Ints,
    near: Mask,
    epochs: int,
    seed: int,
    tested: tuple[int, ...] = tuple(range(_FOLDS)),
) -> dict[int, float]:
    """AUC of each tested fold, without training on that fold or on crops that overlap it.

    Args: pictures: (N, n, n, 3) sRGB; label: (N,) 0 or 1; fold: (N,); near: (N, N) which crops overlap.
    """
    found = {}
    for k in tested:
        inside = fold == k
        taught = ~inside & ~near[inside].any(axis=0)
        if len(np.unique(label[inside])) == len(np.unique(label[taught])) == 2:
            score = trained_scores(pictures[taught], label[taught], pictures[inside], epochs, seed + k)
            found[k] = float(roc_auc_score(label[inside], score))
    return found


def trained_scores(pictures: Pixels, label: Ints, test: Pixels, epochs: int, seed: int) -> Floats:
    """Scores of test crops by a network trained on rotated and mirrored others, labels weighted equally."""
    order = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        net = _network()
        data, truth = _tensor(pictures), torch.from_numpy(label).float()
        weight = torch.tensor(float((label == 0).sum() / max((label == 1).sum(), 1)))
        loss = nn.BCEWithLogitsLoss(pos_weight=weight)
        optimiser = torch.optim.AdamW(net.parameters(), _RATE, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
        for _ in range(epochs):
            for part in torch.split(torch.randperm(len(data), generator=order), _BATCH):
                if len(part) < 2:
                    continue
                turn, mirror = (int(torch.randint(n, (1,), generator=order)) for n in (4, 2))
                batch = torch.rot90(data[part], turn, (2, 3))
                optimiser.zero_grad()
                loss(net(batch.flip(3) if mirror else batch)[:, 0], truth[part]).backward()
                optimiser.step()
            schedule.step()
    with torch.no_grad():
        scores = [net.eval()(part)[:, 0] for part in torch.split(_tensor(test), 64)]
    return np.asarray(torch.cat(scores).double().numpy())


def _network() -> nn.Module:
    """Four strided convolutions and the mean over the crop."""
    widths = [3, *(k * _WIDTH for k in (1, 2, 3, 4))]
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Conv2d(before, after, 3, 2, 1), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(
        *layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Dropout(0.3), nn.Linear(widths[-1], 1)
    )


def _tensor(pictures: Pixels) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).float() / 127.5 - 1


STUDY = Study(measure, "render/appearance/classifier.json", page, ("{photo}",))
