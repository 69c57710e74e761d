"""`bench pages`: pictures and pages of the results, from their data; or whether they still are so."""

from __future__ import annotations

from pathlib import Path

from bench import sheet, sheets


def stale(folder: Path) -> list[Path]:
    """Files under a folder of results that are not what its data say."""
    return [place / name for place, one in sheets.every(folder) for name in sheet.stale(one, place)]


def write(folder: Path) -> list[Path]:
    """Writes them; gives back those that changed."""
    return [place / name for place, one in sheets.every(folder) for name in sheet.write(one, place)]
