"""Who is fitted, who chooses the epoch, who intervals are fitted on and who is tested: every rule of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from learn.checkpoint import SEEN, ModelCard
from learn.data.clips import Clip
from learn.uncertainty import conformal
from learn.uncertainty.conformal import LEVELS
from synth.dataset.index import read_split
from synth.dataset.split import SIDES, DatasetSplit, find_crossings, join_groups
from synth.errors import UserError

Note = Callable[[str], None]
"""Gets what a person should know of a split."""
Unit = Literal["anatomy", "opening", "sequence"]
"""What is never on two sides."""
_SEQUENCE = "/"  # between the anatomy and the sequence in a group's name; in none of an anatomy or opening
_OPENING = " at "  # between the anatomy and the place
LEAST_CHOSEN = 3
"""Brains that the scale of the errors must be seen on."""


@dataclass(frozen=True)
class Split:
    """Indices into the list of clips; the parts share no sequence, no group and no held-out family."""

    fit: tuple[int, ...]
    select: tuple[int, ...]
    test: tuple[int, ...]
    intervals: tuple[int, ...] = ()
    """Neither fitted nor chosen on, and no test: what intervals are fitted on."""
    hashes: tuple[str, ...] = ()
    """Of the split of each dataset that this is made from."""


def divide(
    clips: list[Clip], datasets: Sequence[Path], seed: int, note: Note = lambda text: None
) -> tuple[list[Clip], Split]:
    """The clips in their groups, and the parts: train, validation and test of the datasets' splits.

    A group that two datasets put on two sides is in the later one's part only, and what is elsewhere is left
    out: nothing is fitted that a dataset calls test.

    Args:
        clips: all sequences of the datasets.
        datasets: where they came from.
        seed: of the draw of those that are kept for intervals.
        note: see `Note`.

    Raises:
        UserError: a dataset with too few groups to split, or none to fit or to choose on.
    """
    splits, where = [read_split(one) for one in datasets], " ".join(map(str, datasets))
    if shared := {one.by == "opening" for one in splits if one.share_anatomy}:
        clips = regroup(clips, "opening" if shared == {True} else "sequence")
        note("One brain may be on several sides of the split: scores say nothing of other brains.")
    names = [clip.content_hash for clip in clips]
    DatasetSplit(sides={k: v for one in splits for k, v in one.sides.items()}).find(names, where)
    own = [{SIDES.index(one.sides[name]) for one in splits if name in one.sides} for name in names]
    number, last = groups(clips), dict[int, int]()
    for group, found in zip(number, own, strict=True):
        last[group] = max(last.get(group, 0), *found)
    fit, select, test = (
        tuple(k for k, group in enumerate(number) if own[k] == {part} == {last[group]}) for part in range(3)
    )
    if left := len(clips) - len(fit) - len(select) - len(test):
        note(f"{left} sequences are left out: another of the datasets has their brain on another side.")
    for side, part in zip(SIDES, (fit, select), strict=False):
        if not part:
            raise UserError(f"{where}: no sequence is for {side}; give it some by `synth split --shares`")
    split = Split(fit, select, test, hashes=tuple(one.hash for one in splits))
    return clips, keep_back(clips, split, seed)


def keep_back(clips: Sequence[Clip], split: Split, seed: int) -> Split:
    """The split with half of the brains that choose the epoch kept for intervals instead.

    They are drawn, not dealt by size, so that they are like any brain to come. Where half would be too few
    for 90%, the split stays as it is.
    """
    number = groups(clips)
    names = np.unique([number[i] for i in split.select])
    if len(names) < 2 * conformal.least_units(LEVELS[0]):
        return split
    drawn = np.random.default_rng([seed, 0x1E7]).permutation(names)[: len(names) // 2]
    calibration = tuple(i for i in split.select if number[i] in drawn)
    select = tuple(i for i in split.select if i not in calibration)
    return replace(split, select=select, intervals=calibration)


def name_parts(clips: Sequence[Clip], split: Split) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Content hashes and groups of each part, as a model's card has them. UserError if two share a group."""
    parts = {"fit": split.fit, "select": split.select, "test": split.test}
    if split.intervals:
        parts["intervals"] = split.intervals
    number, sides = groups(clips), [(i, side) for side, part in parts.items() for i in part]
    if find_crossings([number[i] for i, _ in sides], [side for _, side in sides]):
        raise UserError("the split shares an anatomy between its parts")
    return (
        {k: [clips[i].content_hash for i in v] for k, v in parts.items()},
        {k: sorted({clips[i].group for i in v}) for k, v in parts.items()},
    )


def choose_unseen(
    clips: list[Clip], dataset: Path, cards: Sequence[ModelCard], note: Note = lambda text: None
) -> list[Clip]:
    """Those that no model has seen; of a dataset that one has met, of its test side. UserError if none is."""
    split, asked = read_split(dataset, required=False), clips
    met = {name for card in cards for part in card.split.values() for name in part}
    if split.sides and any(clip.content_hash in met for clip in clips):
        asked = [clip for clip in clips if split.sides.get(clip.content_hash) == "test"]
    chosen = asked
    for card in cards:
        chosen = unseen(chosen, card)
    if not chosen:
        raise UserError(
            f"{dataset}: the model was fitted or chosen on the brains of all {len(asked)} sequences that are "
            "for testing; `synth split` says which are"
        )
    if left := len(asked) - len(chosen):
        note(f"{left} of {len(asked)} left out: the model was fitted or chosen on their brains.")
    return chosen


def unseen(clips: Sequence[Clip], card: ModelCard) -> list[Clip]:
    """Clips of no sequence and no anatomy that the model was fitted or chosen on, or its intervals fitted."""
    met = _met(regroup(clips, find_unit(card)), card, SEEN)
    return [clip for i, clip in enumerate(clips) if i not in met]


def find_sides(clips: Sequence[Clip], card: ModelCard, test: Collection[str], from_test: bool) -> Split:
    """Who of a dataset's sequences a trained model's intervals are fitted on, brain by brain.

    Kept for it is what was already; else every brain that the model has not met and that has no test
    sequence; with `from_test` half of the brains of the test instead, drawn, and the other half stays it.
    Where too few brains chose the epoch, those that the error model still lacks are drawn from these.

    Args:
        clips: of the dataset.
        card: of the model.
        test: content hashes of those marked test, beside the card's.
        from_test: whether test sequences may be taken.
    """
    number = groups(clips)

    def brains(part: str, more: Collection[str] = ()) -> set[int]:
        return {number[i] for i in _met(clips, card, [part], more)}

    def of(chosen: Collection[int]) -> tuple[int, ...]:
        return tuple(i for i in range(len(clips)) if number[i] in chosen)

    rng = np.random.default_rng(card.settings.seed)
    fitted, chosen = brains("fit"), brains("select")
    calibration, tests = brains("intervals") - fitted - chosen, brains("test", test) - fitted - chosen
    if from_test:
        drawn = rng.permutation(sorted(tests))
        calibration = {int(brain) for brain in drawn[: len(tests) // 2]}
    elif not calibration:
        calibration = set(number) - fitted - chosen - tests
    left, lacking = tests - calibration, max(LEAST_CHOSEN - len(chosen), 0)
    if len(calibration) >= conformal.least_units(LEVELS[0]) + lacking:
        lent = {int(brain) for brain in rng.permutation(sorted(calibration))[:lacking]}
        chosen, calibration = chosen | lent, calibration - lent
    return Split(of(fitted), of(chosen), of(left), of(calibration))


def find_obstacle(selection: Sequence[Clip], calibration: Sequence[Clip]) -> str:
    """Why there can be no intervals; empty if there can be.

    `selection`: sequences that the scale is fitted on; `calibration`: those that the factors come from.
    """
    least = conformal.least_units(LEVELS[0])
    parts = (
        ("kept for intervals", calibration, least),
        ("left to choose the epoch, on which the scale of errors is fitted", selection, LEAST_CHOSEN),
    )
    for what, part, needed in parts:
        found = len(set(groups(part)))
        if found < needed:
            brains = "brain is" if found == 1 else "brains are"
            return (
                f"{found} {brains} {what}; {LEVELS[0]:.0%} intervals need {needed}: of {2 * least} or more "
                "on the validation side half are kept (more sequences, or `synth split --shares`)"
            )
    return ""


def regroup(clips: Sequence[Clip], unit: Unit) -> list[Clip]:
    """The clips with their anatomies, each place that these are opened at, or each sequence as groups.

    Two of one brain are then no strangers: scores say nothing of other brains.
    """
    if unit == "opening":
        return [replace(c, group=c.opening or c.group) for c in clips]
    if unit == "sequence":
        return [replace(c, group=f"{c.group}{_SEQUENCE}{c.content_hash}") for c in clips]
    return list(clips)


def find_unit(card: ModelCard) -> Unit:
    """What the groups of a model's card are."""
    names = [name for part in card.groups.values() for name in part]
    if any(_SEQUENCE in name for name in names):
        return "sequence"
    return "opening" if any(_OPENING in name for name in names) else "anatomy"


def groups(clips: Sequence[Clip]) -> list[int]:
    """A group number for each clip: equal where two share an anatomy or are the same sequence twice."""
    return join_groups([c.group for c in clips], [c.content_hash for c in clips])


def _met(
    clips: Sequence[Clip], card: ModelCard, parts: Sequence[str], more: Collection[str] = ()
) -> set[int]:
    """Indices of the clips that some parts of a card hold, by content (`more` too) or by group."""
    hashes = {*more, *(name for part in parts for name in card.split.get(part, ()))}
    names = {name for part in parts for name in card.groups.get(part, ())}
    return {i for i, c in enumerate(clips) if c.content_hash in hashes or c.group in names}
