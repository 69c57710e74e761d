"""What a measurement leaves in its folder: each file whole or not at all, whoever stops the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from synth.dataset.folder import write_whole


def keep(folder: Path, name: str, what: Any, *, allow_nan: bool = True) -> None:
    """Writes the file `name` in `folder`, which is made if need be: text as it is, all else as JSON.

    Raises ValueError for a number that is none, which strict readers of JSON refuse, unless `allow_nan`.
    """
    text = what if isinstance(what, str) else _json(what, allow_nan) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / name, text, durable=False)


def _json(what: Any, allow_nan: bool, depth: int = 2) -> str:
    """JSON with a line for each key, and for each row of a list under it: short, and rows can be compared."""
    if depth and isinstance(what, dict) and what:
        lines = (f"{json.dumps(k)}: {_json(v, allow_nan, depth - 1)}" for k, v in what.items())
        return "{\n" + ",\n".join(lines) + "\n}"
    if depth and isinstance(what, list | tuple) and any(isinstance(item, dict | list) for item in what):
        return "[\n" + ",\n".join(_json(item, allow_nan, 0) for item in what) + "\n]"
    return json.dumps(what, separators=(",", ":"), allow_nan=allow_nan)
