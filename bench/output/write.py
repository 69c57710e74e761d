"""What a measurement leaves in its folder: each file whole or not at all, whoever stops the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from synth.dataset.folder import write_whole


def keep(folder: Path, name: str, what: Any) -> None:
    """Writes the file `name` in `folder`, which is made if need be: text as it is, all else as JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    text = what if isinstance(what, str) else json.dumps(what, indent=1) + "\n"
    write_whole(folder / name, text, durable=False)
