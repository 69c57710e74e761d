"""Division of sequences into training (fit), validation (select), interval and test parts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from learn.checkpoint import USED, ModelCard
from learn.data.clips import Clip
from learn.uncertainty import conformal
from learn.uncertainty.conformal import LEVELS
from synth.dataset.index import read_split
from synth.dataset.sequence_split import SIDES, DatasetSplit, find_crossings, join_groups
from synth.errors import UserError

Note = Callable[[str], None]  # receives warnings about a split
Unit = Literal["anatomy", "opening", "sequence"]  # what is never on two sides of a split
_SEQUENCE = "/"  # between anatomy and sequence in a group's name; never in the name of an anatomy or opening
_OPENING = " at "  # between anatomy and place of the craniotomy
LEAST_SELECTED = 3  # brains that the error model needs


@dataclass(frozen=True)
class Split:
    """Indices into the list of clips; the parts share no sequence and no group."""

    fit: tuple[int, ...]
    select: tuple[int, ...]
    test: tuple[int, ...]
    intervals: tuple[int, ...] = ()  # for prediction intervals only
    hashes: tuple[str, ...] = ()  # of the splits of the datasets


def divide(
    clips: list[Clip], datasets: Sequence[Path], seed: int, note: Note = lambda text: None
) -> tuple[list[Clip], Split]:
    """The clips with their groups, and their division by the datasets' splits.

    Of a group on different sides in two datasets only the sequences on the later side (train, validation,
    test) are used. `seed`: of `keep_back`. UserError for too few groups to split, or an empty fit or select
    part.
    """
    splits, label = [read_split(dataset) for dataset in datasets], " ".join(map(str, datasets))
    if shared := {dataset_split.by == "opening" for dataset_split in splits if dataset_split.share_anatomy}:
        clips = regroup(clips, "opening" if shared == {True} else "sequence")
        note("Brains may be on several sides of the split: scores don't apply to other brains.")
    names = [clip.content_hash for clip in clips]
    DatasetSplit(sides={k: v for dataset_split in splits for k, v in dataset_split.sides.items()}).find(
        names, label
    )
    sides = [
        {SIDES.index(dataset_split.sides[name]) for dataset_split in splits if name in dataset_split.sides}
        for name in names
    ]
    group_numbers, last_side = groups(clips), dict[int, int]()
    for group, group_sides in zip(group_numbers, sides, strict=True):
        last_side[group] = max(last_side.get(group, 0), *group_sides)
    fit, select, test = (
        tuple(k for k, group in enumerate(group_numbers) if sides[k] == {part} == {last_side[group]})
        for part in range(3)
    )
    if excluded := len(clips) - len(fit) - len(select) - len(test):
        note(f"{excluded} sequences are left out: another dataset has their brain on another side.")
    for side, part in zip(SIDES, (fit, select), strict=False):
        if not part:
            raise UserError(f"{label}: the {side} side is empty; change it with `synth split --shares`")
    split = Split(fit, select, test, hashes=tuple(dataset_split.hash for dataset_split in splits))
    return clips, keep_back(clips, split, seed)


def keep_back(clips: Sequence[Clip], split: Split, seed: int) -> Split:
    """The split with a random half of the select part's brains, if enough, moved to the interval part."""
    group_numbers = groups(clips)
    names = np.unique([group_numbers[i] for i in split.select])
    if len(names) < 2 * conformal.least_units(LEVELS[0]):
        return split
    calibration_groups = np.random.default_rng([seed, 0x1E7]).permutation(names)[: len(names) // 2]
    select, calibration = (
        tuple(i for i in split.select if (group_numbers[i] in calibration_groups) == is_calibration)
        for is_calibration in (False, True)
    )
    return replace(split, select=select, intervals=calibration)


def add_labels(clips: Sequence[Clip], split: Split, labels: Sequence[Clip]) -> tuple[list[Clip], Split]:
    """All clips, `labels` in the fit part but for copies and for those with a brain of another part.

    UserError: none of them is left.
    """
    hashes = {clip.content_hash for clip in clips}
    new = [label for label in labels if label.content_hash not in hashes]
    if labels and not new:
        raise UserError("--labels: holds the training data itself; give a dataset of other sequences")
    all_clips = [*clips, *regroup(new, _unit(clip.group for clip in clips))]
    group_numbers = groups(all_clips)
    barred = {group_numbers[i] for part in (split.select, split.test, split.intervals) for i in part}
    added = [i for i in range(len(clips), len(all_clips)) if group_numbers[i] not in barred]
    if labels and not added:
        raise UserError(
            "--labels: all of its brains are on the other sides of the dataset's split; render others"
        )
    return all_clips, replace(split, fit=(*split.fit, *added))


def name_parts(clips: Sequence[Clip], split: Split) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Content hashes and groups of each part, for a model's card. UserError if two parts share a group."""
    parts = {"fit": split.fit, "select": split.select, "test": split.test}
    if split.intervals:
        parts["intervals"] = split.intervals
    group_numbers, sides = groups(clips), [(i, side) for side, part in parts.items() for i in part]
    if find_crossings([group_numbers[i] for i, _ in sides], [side for _, side in sides]):
        raise UserError("the split shares an anatomy between its parts")
    return (
        {k: [clips[i].content_hash for i in v] for k, v in parts.items()},
        {k: sorted({clips[i].group for i in v}) for k, v in parts.items()},
    )


def choose_unseen(
    clips: list[Clip], dataset: Path, card: ModelCard, note: Note = lambda text: None
) -> list[Clip]:
    """Sequences that a model was not trained on; of a training dataset, of its test side. UserError: none."""
    split, candidates = read_split(dataset, required=False), clips
    training_hashes = {name for part in card.split.values() for name in part}
    if split.sides and any(clip.content_hash in training_hashes for clip in clips):
        candidates = [clip for clip in clips if split.sides.get(clip.content_hash) == "test"]
    unseen = keep_unseen(candidates, card)
    if not unseen:
        raise UserError(
            f"{dataset}: the model was trained on the brains of all {len(candidates)} test sequences; use "
            "other data (`synth split` lists the sides)"
        )
    if excluded := len(candidates) - len(unseen):
        note(f"{excluded} of {len(candidates)} left out: the model was trained on their brains.")
    return unseen


def keep_unseen(clips: Sequence[Clip], card: ModelCard) -> list[Clip]:
    """Clips that share neither sequence nor anatomy with the parts `USED` of the model's split."""
    brains, used_hashes = {name for part in USED for name in card.groups.get(part, ())}, card.used
    grouped = zip(clips, regroup(clips, find_unit(card)), strict=True)
    return [
        c for c, regrouped in grouped if c.content_hash not in used_hashes and regrouped.group not in brains
    ]


def find_obstacle(selection: Sequence[Clip], calibration: Sequence[Clip]) -> str:
    """Why intervals can't be fitted on these sequences (error model, factors); empty if they can."""
    least = conformal.least_units(LEVELS[0])
    for purpose, part, needed in (
        ("left for intervals", calibration, least),
        ("left to choose the epoch and to fit the error model", selection, LEAST_SELECTED),
    ):
        if (count := len(set(groups(part)))) < needed:
            brains = "brain is" if count == 1 else "brains are"
            return (
                f"{count} {brains} {purpose}; {LEVELS[0]:.0%} intervals need {needed}, and {2 * least} on "
                "the validation side, half of which are used (more sequences, or `synth split --shares`)"
            )
    return ""


def regroup(clips: Sequence[Clip], unit: Unit) -> list[Clip]:
    """The clips grouped by anatomy, by place of the craniotomy, or not at all."""
    if unit == "opening":
        return [replace(c, group=c.opening or c.group) for c in clips]
    if unit == "sequence":
        return [replace(c, group=f"{c.group}{_SEQUENCE}{c.content_hash}") for c in clips]
    return list(clips)


def find_unit(card: ModelCard) -> Unit:
    """The unit of the groups in a model's card."""
    return _unit(name for part in card.groups.values() for name in part)


def _unit(names: Iterable[str]) -> Unit:
    names = [*names]
    if any(_SEQUENCE in name for name in names):
        return "sequence"
    return "opening" if any(_OPENING in name for name in names) else "anatomy"


def groups(clips: Sequence[Clip]) -> list[int]:
    """A group number for each clip, equal for clips of one anatomy and for copies of one sequence."""
    return join_groups([c.group for c in clips], [c.content_hash for c in clips])
