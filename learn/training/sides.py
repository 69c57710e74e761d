"""Who of some datasets is fitted, who chooses the epoch, and who is left for the test and for intervals."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from learn.data.clips import Clip
from learn.data.split import Split, groups, keep_written, nested, ungrouped
from learn.evaluation.interval_sides import keep_back
from learn.settings import TrainingSettings, replace
from synth.dataset.index import written_sides
from synth.dataset.split import Rule, find_crossings, read_rule
from synth.errors import UserError


def divide(
    clips: list[Clip],
    datasets: Sequence[Path],
    settings: TrainingSettings,
    given: Collection[str] = (),
    note: Callable[[str], None] = lambda text: None,
) -> tuple[list[Clip], Split, TrainingSettings]:
    """The clips in their groups, the split, and the settings as the datasets changed them.

    Args:
        clips: all sequences of the datasets.
        datasets: where they came from; what `synth split` wrote there decides.
        settings: of the training.
        given: names of those that somebody asked for; the others may change.
        note: gets what a person should know of the split.

    Raises:
        UserError: datasets that are not split alike, an anatomy on two of their sides, or too few groups.
    """
    sides, rule = _written(datasets)
    if rule is not None:
        if asked := [name for name in ("folds", "fold", "held_out_family") if name in given]:
            where = f"{datasets[0]}: is split already (split.json, by `synth split`)"
            raise UserError(f"{where}: leave out {', '.join(asked)}")
        settings = replace(settings, share_anatomy=settings.share_anatomy or rule.share_anatomy)
    if settings.share_anatomy:
        # A written split that doesn't keep openings apart would have one on two sides.
        clips = ungrouped(clips, by_opening=None if rule is None or rule.by == "opening" else False)
        apart = "" if len(set(groups(clips))) == len(clips) else " Its openings are kept apart."
        note(f"One brain may be on several sides of the split: scores say nothing of other brains.{apart}")
    if rule is not None:
        note("The dataset's own split: what `synth split` marks test is neither fitted nor chosen on.")
        placed = [k for k, clip in enumerate(clips) if clip.content_hash in sides]
        number, names = groups(clips), [clip.content_hash for clip in clips]
        if torn := find_crossings([number[k] for k in placed], [sides[names[k]] for k in placed]):
            raise UserError(
                f"--also: {len(torn)} of the anatomies are on two sides of the datasets' splits; split by "
                "their own (leave out split.json of both), or train on one"
            )
        split = keep_written(clips, sides, settings.seed)
    else:
        if "folds" not in given:
            settings = replace(settings, folds=min(settings.folds, len(set(groups(clips)))))
        split = nested(clips, settings.folds, settings.fold, settings.seed, settings.held_out_family)
    return clips, keep_back(clips, split, settings.seed), settings


def _written(datasets: Sequence[Path]) -> tuple[dict[str, str], Rule | None]:
    """The sides that `synth split` wrote, by content hash, and its rule; None if there is no split."""
    found = {one: written_sides(one) for one in datasets}
    rules = {one: None if sides is None else read_rule(one) for one, sides in found.items()}
    first = rules[datasets[0]]
    for one, rule in rules.items():
        if rule != first:
            raise UserError(f"{one}: is not split as {datasets[0]} is: `synth split` both alike, or neither")
    return {name: side for sides in found.values() for name, side in (sides or {}).items()}, first
