"""The log of a run, epoch by epoch: history.jsonl and TensorBoard events."""

from __future__ import annotations

import json
from pathlib import Path

from tensorboardX import SummaryWriter


class Log:
    """Writes each epoch's numbers into `folder`/history.jsonl and `folder`/tensorboard."""

    def __init__(self, folder: Path, start: int) -> None:
        """`start`: number of epochs done by a run that is continued; later entries are dropped."""
        self._file = folder / "history.jsonl"
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=start)

    def __call__(self, epoch: int, numbers: dict[str, float]) -> None:
        """Logs the numbers of epoch `epoch`, counted from 0."""
        lines = self._file.read_text().splitlines()[:epoch] if self._file.exists() else []
        self._file.write_text("\n".join([*lines, json.dumps(numbers)]) + "\n")
        for name, value in numbers.items():
            self._board.add_scalar(name.replace("_", "/", 1), value, epoch)
        self._board.flush()

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._board.close()
