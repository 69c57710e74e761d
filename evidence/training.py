"""Networks of studies: cross-validation folds that share no anatomy, stored trainings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from evidence import result_cache
from learn import checkpoint
from learn.data.clips import Clip
from learn.inference.convert import to_onnx
from learn.inference.predict import Predictor, load_model
from learn.network.registry import build
from learn.settings import TrainingSettings
from learn.split import Split, groups
from learn.training.train import train
from synth.dataset.sequence_split import draw_groups
from synth.formats import CLIPS

_EPOCH = "epoch-{:03d}.pt"
_ROUNDING = 0.01  # of the networks after the first epochs in ONNX, whose normalisation is still by few frames


def folds(clips: Sequence[Clip], count: int, seed: int) -> list[tuple[int, ...]]:
    """Indices of `count` sets of clips of nearly equal size that share no group."""
    number = groups(clips)
    order = np.random.default_rng(seed).permutation(sorted(set(number))).tolist()
    part = draw_groups(number, [1.0] * count, order)
    return [tuple(i for i, k in enumerate(part) if k == fold) for fold in range(count)]


def split_nested(clips: Sequence[Clip], count: int, fold: int, seed: int) -> Split:
    """Split whose test is fold `fold` of `count`; a fifth of the remainder selects the epoch."""
    test = folds(clips, count, seed)[fold]
    rest = [i for i in range(len(clips)) if i not in set(test)]
    inner = [clips[i] for i in rest]
    selected_fold = folds(inner, min(5, len(set(groups(inner)))), seed)[0]
    select = tuple(rest[k] for k in selected_fold)
    return Split(tuple(i for i in rest if i not in select), select, test)


def fit(
    name: str,
    clips: Sequence[Clip],
    split: Split,
    settings: TrainingSettings,
    folder: Path,
    device: str = "cpu",
) -> Predictor:
    """Network trained on fit and select of a split, stored in `folder`; an interrupted training continues.

    `name`: part of the key, next to settings and the clips' hashes.
    """
    return fit_with_epochs(name, clips, split, settings, folder, (), device)[0]


def fit_with_epochs(
    name: str,
    clips: Sequence[Clip],
    split: Split,
    settings: TrainingSettings,
    folder: Path,
    epochs: Sequence[int],
    device: str = "cpu",
) -> tuple[Predictor, dict[int, Predictor]]:
    """As `fit`, and the networks as they were after some of the epochs, by epoch."""
    split_hashes = [[clips[i].content_hash for i in part] for part in (split.fit, split.select)]
    key = result_cache.key(settings.model_dump(), split_hashes, CLIPS, versions=("TRAINING",))
    model = folder / f"{name}-{key}"

    def keep(numbers: Mapping[str, float]) -> None:
        epoch = int(numbers["epoch"])
        if epoch in epochs:
            state = checkpoint.read_tensors(model / "last.pt")["model"]
            checkpoint.save_tensors(
                model / _EPOCH.format(epoch), {"model": state, "gain": numbers["select_gain"]}
            )

    card = train(clips, split, settings, model, device=device, log=keep)
    earlier = {}
    for epoch in epochs:
        if (file := model / _EPOCH.format(epoch)).exists():
            tensors = checkpoint.read_tensors(file)
            network = build(settings.network, settings.arch)
            network.load_state_dict(tensors["model"])
            at_epoch = replace(card, epoch=epoch, force_gain=tensors["gain"])
            earlier[epoch] = Predictor(at_epoch, to_onnx(network, at_epoch, tolerance=_ROUNDING)[0])
    return load_model(model), earlier
