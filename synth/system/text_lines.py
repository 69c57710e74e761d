"""Lines of text for a terminal, wrapped at spaces and never truncated."""

from __future__ import annotations

import shutil
import textwrap

_LEAST = 16  # columns


def hang(head: str, text: str) -> list[str]:
    """`text` after `head`, wrapped to the terminal's width with a hanging indent."""
    width = max(_LEAST, shutil.get_terminal_size().columns - len(head))
    words = textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False) or [""]
    return [f"{' ' * len(head) if k else head}{line}".rstrip() for k, line in enumerate(words)]
