"""What a run of `synth tune` has measured so far, so that a stopped one goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.folder import write_whole
from synth.errors import UserError
from synth.tune.probe import Measured


class Journal:
    """One JSON line a measurement; the first line says of which job."""

    def __init__(self, path: Path, of: str) -> None:
        """Takes up the file if there is one, starts it otherwise.

        Raises:
            UserError: the file cannot be written, or is of something else.
        """
        self._path = path
        self._known: dict[str, Measured | str] = {}
        try:
            lines = path.read_text("utf-8").splitlines() if path.exists() else []
            if not lines:
                path.write_text(json.dumps(of) + "\n", "utf-8")
                return
            before = json.loads(lines[0])
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: cannot be read or written ({error})") from error
        if before != of:
            raise UserError(f"{path}: is of another job or version; remove it to start anew")
        for line in lines[1:]:
            try:
                key, value = json.loads(line)
            except ValueError:
                break  # cut off while it was written
            self._known[key] = _read(value)
        # Without a line that was cut off.
        kept = [json.dumps(of), *(json.dumps([k, _plain(v)]) for k, v in self._known.items())]
        write_whole(path, "\n".join(kept) + "\n")

    def get(self, key: str) -> Measured | str | None:
        return self._known.get(key)

    def put(self, key: str, found: Measured | str) -> None:
        self._known[key] = found
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([key, _plain(found)]) + "\n")


def _plain(found: Measured | str) -> Any:
    if isinstance(found, str):
        return found
    seen = None if found.seen is None else found.seen.tolist()
    return {"label": found.label.tolist(), "seen": seen, "cost": found.cost}


def _read(value: Any) -> Measured | str:
    if isinstance(value, str):
        return value
    seen = None if value["seen"] is None else np.asarray(value["seen"])
    return Measured(np.asarray(value["label"]), seen, value["cost"])
