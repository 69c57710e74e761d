"""Lines that people read in a terminal: words wrapped below each other, never cut off."""

from __future__ import annotations

import shutil
import textwrap

_LEAST = 16


def columns() -> int:
    """How wide the terminal is, or what COLUMNS says; 80 where there is none."""
    return shutil.get_terminal_size().columns


def hang(head: str, text: str, width: int | None = None) -> list[str]:
    """`text` after `head`, wrapped at spaces, its further lines below its first.

    `width`: columns in all, the terminal's if not given. A word that is longer stays whole.
    """
    room = max(_LEAST, (columns() if width is None else width) - len(head))
    words = textwrap.wrap(text, room, break_long_words=False, break_on_hyphens=False) or [""]
    return [f"{' ' * len(head) if k else head}{line}".rstrip() for k, line in enumerate(words)]
