"""`bench demo`: a sequence that a model has not seen, as a recording."""

from __future__ import annotations

import shutil
from pathlib import Path

from bench.recording.from_sequence import export_recording
from learn.checkpoint import SEEN, read_card
from learn.inference.shipped import find_model
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError

_MARK = "made-by-demo.txt"


def export_unseen(dataset: Path, model: Path, folder: Path) -> int:
    """Exports the first sequence that the model has not seen, and says which one it is.

    Args:
        dataset: where the model's training data came from.
        model: folder of `learn train`.
        folder: of the recording; what an earlier demo left there is replaced.

    Raises:
        UserError: the model has seen every sequence, or a folder that no demo left.
    """
    chosen = find_unseen(dataset, model)
    if folder.is_symlink() or folder.exists():
        if folder.is_symlink() or not (folder / _MARK).is_file():
            raise UserError(f"{folder}: not from `bench demo`, so not replaced; remove it, or say --out")
        shutil.rmtree(folder)
    export_recording(chosen, folder)
    (folder / _MARK).write_text("`bench demo` wrote this folder and replaces it when it runs again.\n")
    return chosen.index


def find_unseen(dataset: Path, model: Path) -> Sequence:
    """The first sequence that the model was neither fitted nor chosen on. UserError if there is none."""
    split = read_card(find_model(model)).split
    seen = {name for part in SEEN for name in split.get(part, [])}
    for sequence in Dataset(dataset):
        if sequence.attrs["content_hash"] not in seen:
            return sequence
    raise UserError(f"{dataset}: the model was fitted or chosen on every sequence here")
