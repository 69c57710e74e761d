"""What is kept of measurements is small, and every page of it can be reached from its room's."""

from __future__ import annotations

from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[2] / "docs" / "results"
ROOMS = sorted(page.parent for page in RESULTS.glob("*/README.md"))


def test_results_are_under_two_megabytes() -> None:
    assert sum(file.stat().st_size for file in RESULTS.rglob("*") if file.is_file()) < 2_000_000


def test_the_index_names_every_room() -> None:
    folders = {folder.name for folder in RESULTS.iterdir() if folder.is_dir()}
    assert folders == {room.name for room in ROOMS}
    index = (RESULTS / "README.md").read_text("utf-8")
    assert [name for name in sorted(folders) if f"]({name}/README.md)" not in index] == []


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.name)
def test_a_room_links_its_pages(room: Path) -> None:
    words = (room / "README.md").read_text("utf-8")
    for folder in {page.parent for page in [*room.rglob("*.html"), *room.rglob("*.md")]} - {room}:
        # Where a folder has Markdown of its own, that is the way in.
        pages = sorted(folder.glob("*.md")) or sorted(folder.glob("*.html"))
        assert any(f"]({page.relative_to(room)})" in words for page in pages), folder
