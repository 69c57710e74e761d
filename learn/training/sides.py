"""Who of some datasets is fitted, who chooses the epoch, and who is left for the test and for intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from learn.data.clips import Clip
from learn.data.split import Split, groups, regroup
from learn.evaluation.interval_sides import keep_back
from synth.dataset.index import read_split
from synth.dataset.split import SIDES, DatasetSplit
from synth.errors import UserError


def divide(
    clips: list[Clip],
    datasets: Sequence[Path],
    seed: int,
    note: Callable[[str], None] = lambda text: None,
) -> tuple[list[Clip], Split]:
    """The clips in their groups, and the parts: train, validation and test of the datasets' splits.

    A group that two datasets put on two sides is in the later one's part only, and what is elsewhere is left
    out: nothing is fitted that a dataset calls test.

    Args:
        clips: all sequences of the datasets.
        datasets: where they came from.
        seed: of the draw of those that are kept for intervals.
        note: gets what a person should know of the split.

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
