"""`bench pages`: pictures and pages of the results, from their data; or whether they still are so."""

from __future__ import annotations

from pathlib import Path

from bench.output import result_page
from evidence import pages


def stale(folder: Path) -> list[Path]:
    """Files under a folder of results that are not what its data say."""
    return [place / name for place, one in pages.every(folder) for name in result_page.stale(one, place)]


def write(folder: Path) -> list[Path]:
    """Writes them; gives back those that changed."""
    return [place / name for place, one in pages.every(folder) for name in result_page.write(one, place)]
