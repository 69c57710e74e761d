"""`bench demo`: a sequence that no model has seen, as a recording, and the networks that it is scored by."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from bench.recording.from_sequence import export_recording
from learn.checkpoint import SEEN, read_card
from learn.inference.shipped import choose_model, find_model
from synth.dataset.store import Dataset
from synth.dataset.store import Sequence as StoredSequence
from synth.errors import UserError

_MARK = "made-by-demo.txt"


def export_unseen(dataset: Path, models: Sequence[Path], folder: Path) -> int:
    """Exports the first sequence that no model has seen, and says which one it is.

    Args:
        dataset: where the training data of one of them came from.
        models: folders of `learn train`.
        folder: of the recording; what an earlier demo left there is replaced.

    Raises:
        UserError: they have seen every sequence, or a folder that no demo left.
    """
    chosen = find_unseen(dataset, models)
    if folder.is_symlink() or folder.exists():
        if folder.is_symlink() or not (folder / _MARK).is_file():
            raise UserError(f"{folder}: not from `bench demo`, so not replaced; remove it, or say --out")
        shutil.rmtree(folder)
    export_recording(chosen, folder)
    (folder / _MARK).write_text("`bench demo` wrote this folder and replaces it when it runs again.\n")
    return chosen.index


def choose_networks(dataset: Path, model: Path) -> tuple[Path, dict[str, Path]]:
    """The network that the report is about, and those beside it, by name.

    The one that comes along leads, whoever scores better: what somebody's first minutes have trained stands
    beside it, named by how much it has seen. Raises UserError for a folder without a model.
    """
    own = find_model(model)
    main = choose_model(two_eyes="rgb_right" in next(iter(Dataset(dataset)))) or own
    fitted = len(read_card(own).split.get("fit", []))
    return main, {} if main == own else {f"trained on {fitted} sequences": own}


def find_unseen(dataset: Path, models: Sequence[Path]) -> StoredSequence:
    """The first sequence that no model was fitted or chosen on. UserError if there is none."""
    splits = [read_card(model).split for model in models]
    seen = {name for split in splits for part in SEEN for name in split.get(part, [])}
    for sequence in Dataset(dataset):
        if sequence.attrs["content_hash"] not in seen:
            return sequence
    raise UserError(f"{dataset}: a model was fitted or chosen on each of its sequences")
