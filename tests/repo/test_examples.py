"""Every example runs and gives the numbers stated here."""

import runpy
import sys
from pathlib import Path

import cv2
import dataset as dataset_recipe
import numpy as np
import own_flow
import own_instrument
import own_law
import own_method
import pytest
import read_dataset
import render_frame
from sources import ROOT

import synth
from synth.checks.verify import verify_dataset
from synth.dataset.store import Dataset
from synth.render.camera.camera import project

pytestmark = pytest.mark.slow


def test_reading_a_dataset(out: Path) -> None:
    figures = read_dataset.describe(Dataset(out)[0])
    assert figures["young_kpa"] == pytest.approx(0.81474, abs=1e-4)
    assert figures["peak_force_mn"] == pytest.approx(4.5239, abs=1e-3)
    assert figures["labelled_force_mn"] == pytest.approx(figures["peak_force_mn"], rel=0.02)
    assert figures["largest_motion_px"] == pytest.approx(5.0368, abs=0.01)
    assert figures["median_flow_error_px"] < 0.2


@pytest.mark.trial
def test_a_dataset_with_custom_motion_camera_and_appearance(tmp_path: Path) -> None:
    dataset_recipe.main(tmp_path / "stirred", 1)
    assert verify_dataset(tmp_path / "stirred").good
    sequence = Dataset(tmp_path / "stirred")[0]
    pose, tip = sequence["camera"][:], np.array(sequence.attrs["mechanics"]["instruments"][0]["tip_mm"])[:, 0]
    swing_deg = np.degrees(np.arccos((np.trace(pose[0, :3, :3].T @ pose[-1, :3, :3]) - 1) / 2))
    assert 4 * 0.44 < swing_deg < 10 * 0.44  # degrees in eleven frames of 25 a second
    is_loaded = np.linalg.norm(sequence["force"][:], axis=1) > 0.1
    diameter_mm = np.linalg.norm(tip[is_loaded, None, :2] - tip[None, is_loaded, :2], axis=-1).max()
    assert 2.0 * 0.8 < diameter_mm < 4.0 * 1.1  # mm, the circle's diameter less what the tissue gives


def test_rendering_a_frame() -> None:
    scene = render_frame.push()
    frame = scene.frame(scene.strongest)
    figures = render_frame.describe(scene, frame)
    assert figures["force_mn"] == pytest.approx(9.71, rel=1e-3)
    assert figures["labelled_force_mn"] == pytest.approx(figures["force_mn"], rel=0.03)
    assert figures["largest_motion_mm"] == pytest.approx(1.528, rel=1e-2)
    assert figures["largest_flow_px"] == pytest.approx(7.311, rel=1e-2)
    assert frame.rgb.shape == (240, 320, 3)
    assert frame.rgb[100:140, 140:180].mean() == pytest.approx(184.2, abs=3)
    half = render_frame.push(0.15)
    assert np.linalg.norm(half.force, axis=1).max() == pytest.approx(figures["force_mn"] / 2, rel=1e-6)
    assert half.motion.displacement[half.strongest].min() > scene.motion.displacement[scene.strongest].min()


def test_an_instrument_of_ones_own(tmp_path: Path) -> None:
    scene = own_instrument.press(tmp_path)
    frame = scene.frame(scene.strongest)
    assert scene.scenario.gestures[0].instrument == "hook.stl"
    tip = scene.motion.tip[scene.strongest].mean(axis=0)
    assert np.hypot(*tip[:2]) == pytest.approx(0, abs=0.6)  # in the middle of the opening
    row, column = np.argwhere(frame.tool).T
    end = project(frame.camera, tip[None])[0]
    assert np.hypot(column - end[0], row - end[1]).min() < 4
    assert 0.01 < frame.tool.mean() < 0.2
    assert np.linalg.norm(scene.force, axis=1).max() > 0.5


@pytest.mark.trial
def test_a_block_of_liver_under_two_lamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["liver_block.py", str(tmp_path)])
    names = runpy.run_path(str(ROOT / "examples" / "liver_block.py"))
    block, lens, rest, truth = names["block"], names["camera"], names["rest"], names["renderer"].rest
    turn, _ = cv2.Rodrigues(lens.rotation)

    def project_points(points: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.projectPoints(points, turn, lens.translation, lens.K, None)[0][:, 0])

    outline = np.rint(cv2.convexHull(project_points(rest).astype(np.float32))).astype(np.int32)
    hull = cv2.fillConvexPoly(np.zeros((240, 320), np.uint8), outline, 1) > 0
    assert (truth.tissue & hull).sum() / (truth.tissue | hull).sum() > 0.98
    corners = (rest + 3 * names["dent"])[block.faces[truth.face[truth.tissue]]]
    moved_px = project_points(np.einsum("nk,nkc->nc", truth.bary[truth.tissue], corners))
    flow, pixels = np.load(tmp_path / "3.npy"), np.argwhere(truth.tissue)[:, ::-1]
    np.testing.assert_allclose(flow[truth.tissue], moved_px - pixels, rtol=0, atol=1e-6)
    sunk_px = 3 * np.sin(np.radians(15)) * 2200 / 291  # 3 mm along z, 9 mm above the plane at 300 mm
    assert np.linalg.norm(flow, axis=2).max() == pytest.approx(sunk_px, rel=0.03)
    assert not flow[~truth.tissue].any()
    pictures = np.stack([cv2.imread(str(tmp_path / f"{k}.png")) for k in range(4)]).astype(float)
    assert np.abs(np.diff(pictures, axis=0)).max(axis=(1, 2, 3)).min() > 100, "highlights move with the dent"
    # Each lamp has a highlight on its own side, and both have two.
    sides = []
    for lamps in (names["lamps"][:1], names["lamps"][1:], names["lamps"]):
        shot = synth.Renderer(synth.SceneContent(block, lamps), lens).render(synth.SceneState(rest), 0)
        assert not shot.tool.any()
        sides.append([int(half.sum()) for half in np.split(shot.glare, 2, axis=1)])
    (left, none), (empty, right), both = sides
    assert none < 0.02 * left
    assert empty < 0.02 * right
    assert both == [pytest.approx(left, rel=0.2), pytest.approx(right, rel=0.2)]
    assert min(left, right) > 100


def test_a_custom_law_stiffens() -> None:
    for name, b in (("example-stiff", 4.0), ("example-plain", 1e-4)):
        synth.add_law(name, own_law.Stiffening(b))
    soft, stiff = own_law.peak_mm("neo-hookean"), own_law.peak_mm("example-stiff")
    assert soft == pytest.approx(0.7758, abs=0.002)
    assert stiff == pytest.approx(0.7252, abs=0.002)
    assert own_law.peak_mm("example-plain") == pytest.approx(soft, rel=1e-3), "for small b it is neo-Hookean"


def test_a_custom_flow_back_end(out: Path) -> None:
    assert own_flow.error_px(Dataset(out)[0]) == pytest.approx(0.285, rel=0.1)


def test_a_custom_method(out: Path, tmp_path: Path) -> None:
    from bench.recording.from_sequence import export_recording

    methods = own_method.score_springs(export_recording(Dataset(out)[0], tmp_path / "recording")).methods
    assert methods["spring"].scores["r"] == pytest.approx(0.99, abs=0.01)
    assert methods["spring"].scores["mae_mn"] == pytest.approx(0.644, rel=0.1)
    assert methods["stiffer"].scores["r"] == pytest.approx(methods["spring"].scores["r"], abs=1e-6)
