"""Recordings of known motion on foreign pictures, and the command that follows them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from evidence.flow import foreign, foreign_pairs
from evidence.flow.foreign_scenes import Field, Recipe, film, recipes

_PLAIN = Recipe(
    0, "tuning", "drawn grey", "", False, "twist", 3.0, "white", 0.0, False, False, 0, 0.0, ()
)  # fmt: skip


@pytest.mark.parametrize("motion", ["pull", "press", "press from behind", "shift", "twist"])
def test_largest_displacement_is_one(motion: str) -> None:
    move = Field.draw(motion, 200, np.random.default_rng(2))
    y, x = np.mgrid[-200:400, -200:400].astype(np.float32)
    assert np.linalg.norm(move.at(np.stack([x, y], -1)), axis=-1).max() == pytest.approx(1.0, abs=2e-3)


def test_film_holds_its_own_truth() -> None:
    """The now frame, read where the flow points, is the rest frame, lit a little otherwise."""
    rest, *later = film(_PLAIN, 96, 6)
    one = max(later, key=lambda shown: shown.amplitude)
    assert np.linalg.norm(one.flow, axis=-1).max() > 1.0
    y, x = np.mgrid[:96, :96].astype(float)
    at = (y + one.flow[..., 1], x + one.flow[..., 0])
    moved = map_coordinates(one.rgb[..., 1].astype(float), at, order=3, mode="nearest")
    inner = (slice(10, -10), slice(10, -10))
    ratio = moved[inner] / rest.rgb[..., 1][inner]
    assert np.abs(ratio - np.median(ratio)).mean() < 0.03  # the bulge's own light
    off = map_coordinates(one.rgb[..., 1].astype(float), (y, x), order=3)[inner] / rest.rgb[..., 1][inner]
    assert np.abs(off - np.median(off)).mean() > 1.5 * np.abs(ratio - np.median(ratio)).mean()


def test_halves_share_no_scene_and_a_scene_does_not_depend_on_how_many_there_are() -> None:
    tuning, reporting = (recipes(half, 6, photographs=False) for half in ("tuning", "reporting"))
    assert not {one.index for one in tuning} & {one.index for one in reporting}
    assert recipes("tuning", 3, photographs=False) == tuning[:3]


def test_speckle_is_found_to_a_fiftieth_of_a_pixel() -> None:
    rest, now, flow, seen = foreign_pairs.speckled(1.25, np.random.default_rng(3))
    assert np.median(foreign_pairs._error("tvl1", rest, now, flow)[seen]) < 0.022


@pytest.mark.slow
def test_chosen_masks_are_as_good_as_the_better_of_all_and_none() -> None:
    """The suite at a small size: all of the third scene's tissue is taken for a tool."""
    rows = [foreign.judge(one, list(film(one, 112, 8))) for one in recipes("tuning", 4, photographs=False)]
    assert sum(row.both for row in rows) > 1.3 * sum(row.auto for row in rows)
    figures = {row["what"]: row["found"] for row in foreign.summarise(rows)}
    assert figures["EPE / better of all masks and none, mean over scenes"] < 1.1
    assert figures["largest share of free tissue masked"] < 0.1
    assert all(row.r > 0.97 for row in rows)
