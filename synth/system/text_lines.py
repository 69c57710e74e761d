"""Lines that people read in a terminal: words wrapped below each other, never cut off."""

from __future__ import annotations

import shutil
import textwrap

_LEAST = 16  # columns


def hang(head: str, text: str) -> list[str]:
    """`text` after `head`, wrapped to the terminal at spaces, its further lines below its first."""
    room = max(_LEAST, shutil.get_terminal_size().columns - len(head))
    words = textwrap.wrap(text, room, break_long_words=False, break_on_hyphens=False) or [""]
    return [f"{' ' * len(head) if k else head}{line}".rstrip() for k, line in enumerate(words)]
