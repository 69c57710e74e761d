"""What the second eye's figures say of answers and troubles that were put in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import phantom
import pytest

from bench.recording import check
from bench.recording.second_eye import LATE
from evidence.end_to_end import second_eye
from evidence.flow import stereo_stability
from evidence.flow.stereo_stability import View, judged, troubles
from learn.data.clips import load_clips
from learn.data.grid import Grid
from synth.errors import UserError
from synth.flow.stereo.rig import Eye, Rig

K = np.array([[900.0, 0, 79.5], [0, 900, 59.5], [0, 0, 1]])
PAIR = Rig(Eye(K, np.zeros(5)), Eye(K, np.zeros(5)), np.eye(3), np.array([-24.0, 0, 0]), (160, 120))


def test_errors_across_and_along_are_those_put_in() -> None:
    rng = np.random.default_rng(0)
    true = [rng.normal(size=(30, 3)) for _ in range(12)]
    said = [one + np.array([0, 0, np.abs(one).mean()]) for one in true]
    found = second_eye.figures(said, true)
    assert found["across"] == 0
    assert found["along"] == found["whole"] > 0.3
    assert found["along_low"] < found["along"] < found["along_high"]


def test_two_eyes_find_a_force_along_the_view_that_flow_does_not_show(tmp_path: Path) -> None:
    """Displacement is the force itself, spread over the grid: of one eye without its third part."""
    phantom.write(tmp_path / "data", 0, anatomy_seed=0, two_eyes=True)
    (base,) = load_clips(tmp_path / "data", Grid(16), ("ideal", "motion-ideal"))
    rng = np.random.default_rng(1)
    clips = []
    for k in range(12):
        force = rng.normal(size=(6, 3))
        moved = (force[:, :, None, None] * base.mask).astype(np.float32)
        clips.append(
            replace(
                base,
                content_hash=str(k),
                displacement={"motion-ideal": moved, "ideal": moved[:, :2]},
                density=np.zeros((6, 3, 16, 16), np.float32),
                force=base.young_kpa * force,
            )
        )
    for source, along in (("motion-ideal", 0.0), ("ideal", 1.0)):
        answer = second_eye.fit_ridge(clips[:8], source)
        found = second_eye.figures([answer(c) for c in clips[8:]], [c.force for c in clips[8:]])
        share = np.mean([np.square(c.force[:, 2]).sum() / np.square(c.force).sum() for c in clips[8:]]) ** 0.5
        assert found["along"] == pytest.approx(along * share, abs=0.06)
        assert found["across"] < 0.02


def test_other_scenes_are_refused(tmp_path: Path) -> None:
    for index in range(2):
        phantom.write(tmp_path / "data", index, anatomy_seed=index)
    one, other = load_clips(tmp_path / "data", Grid(16), ("ideal",))
    second_eye._check_scenes(tmp_path, [one], [one, other])
    with pytest.raises(UserError, match="of another scene"):
        second_eye._check_scenes(tmp_path, [other], [one])
    with pytest.raises(UserError, match="more sequences"):
        second_eye._check_scenes(tmp_path, [one, other], [one])


def test_every_row_is_on_the_page() -> None:
    def row(way: str, size: str, base: float) -> dict[str, object]:
        said = {f"{name}{end}": 0.3 for name in ("whole", "across", "along") for end in ("", "_low", "_high")}
        cost = 0.1 if way.endswith("recovered") else None
        return {"way": way, "size": size, "baseline_mm": base, "cost_s": cost, "sequences": 4} | said

    rows = [row(way, "320 x 240", 24.0) for way in second_eye.SOURCES]
    others = [
        row(way, size, base)
        for way in second_eye.SOURCES
        for size, base in (("320 x 240", 4.0), ("640 x 480", 24.0))
    ]
    page = second_eye.drawn({"rows": rows, "same_scenes": rows + others, "networks": rows[:1]})
    assert len(page.charts) == 2
    assert len(page.sections) == 3
    by_base = page.charts[0]
    assert {curve.x for curve in by_base.curves} == {(4.0, 24.0)}  # type: ignore[union-attr]


def test_what_is_wrong_and_not_said_is_silent() -> None:
    rng = np.random.default_rng(0)
    off = rng.normal(scale=0.3, size=20_000)
    honest = judged(off, np.full(len(off), 0.3), [0.1], [0.0])
    assert honest["flagged"]
    assert (honest["z68"], honest["z95"]) == pytest.approx((1.0, 2.0), abs=0.05)
    quiet = judged(off, np.full(len(off), 0.05), [0.1], [0.0])
    assert quiet["silent"]
    assert not quiet["flagged"]
    by_rows = judged(off, np.full(len(off), 0.05), [check.OFF_ROWS_PX + 0.1], [0.0])
    assert by_rows["flagged"]
    assert not by_rows["silent"]
    assert judged(off, np.full(len(off), 0.05), [0.1], [LATE + 0.1])["flagged"]
    assert judged(np.array([]), np.array([]), [], [])["flagged"]


def test_troubles_are_what_they_are_called() -> None:
    rng = np.random.default_rng(0)
    film = rng.integers(60, 120, (6, 120, 160, 3), dtype=np.uint8)
    view = View(PAIR, film)
    made = {(name, value): spoil(view, np.random.default_rng(1)) for name, value, spoil in troubles()}
    rows = made["rows off [px]", 2.0].rig
    # A point that both lenses see straight ahead is seen 2 px lower or higher by the one that turned.
    at = rows.right.K @ rows.rotation @ np.array([0, 0, 300.0])
    assert abs(at[1] / at[2] - 59.5) == pytest.approx(2.0, rel=1e-3)
    assert np.linalg.norm(rows.translation) == pytest.approx(24)
    late = made["right eye late [frames]", 1.0].right
    np.testing.assert_array_equal(late[1:], film[:-1])
    assert made["right eye's exposure", 0.5].right.mean() == pytest.approx(0.5 * film.mean(), rel=0.02)
    assert (made["right eye blocked [share]", 0.5].right[3:, :, :80] == 0).all()
    assert (made["right eye blocked [share]", 0.5].right[:3] == film[:3]).all()
    bright = (made["glare in the right eye [share]", 0.25].right[1:] > 160).mean()
    assert 0.1 < bright < 0.4
    assert (made["rows off [px]", 0.0].right == film).all()


def test_a_points_curve_is_on_its_panel() -> None:
    rows = [
        {"trouble": "rows off [px]", "value": value, "sequences": 1, "refused": 0}
        | judged(np.full(10, 0.02), np.full(10, 0.02), [value], [0.0])
        for value in (1.0, 0.2)
    ]
    page = stereo_stability.drawn({"rows": rows})
    (panel,) = page.charts
    assert panel.curves[0].x == (0.2, 1.0)  # type: ignore[union-attr]
