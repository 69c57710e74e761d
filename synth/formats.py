"""Versions of the formats on disk, and the check of every reader of them.

A change of what a file means raises its number here. The reader of format N reads N and N - 1, so that what
the release before wrote is still read.
"""

from __future__ import annotations

from synth.errors import UserError

STORE, FOLDER, MODEL = 2, 2, 2
"""Of a sequence store, of a dataset's `dataset.json`, of a model's `config.json`."""
FIRST = 2
"""What 0.2 writes, the first release: nothing older is read."""


def check_format(found: object, current: int, where: str) -> None:
    """Checks the format version `found` in a file against that of its reader, `current`.

    Raises:
        UserError: it is neither `current` nor the one before; `where` names the file.
    """
    readable = [version for version in (current, current - 1) if version >= FIRST]
    if type(found) is not int or found not in readable:
        known = " and ".join(map(str, readable))
        raise UserError(
            f"{where}: written by format {str(found)[:40]}; this version reads {known}: make it anew, or use "
            "the version that wrote it"
        )
