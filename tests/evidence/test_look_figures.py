"""Crops, texture distances and the patch classifier on pictures whose answer is known."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sklearn.metrics import roc_auc_score

from evidence.look import classifier, crops, cues, fit, texture
from synth.errors import UserError
from synth.fit import parameters
from synth.job.schema import Job


def textured(count: int, sigma: float, seed: int) -> np.ndarray:
    """Crops (N, 128, 128, 3) of noise blurred by `sigma` px."""
    import cv2

    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        field = cv2.GaussianBlur(rng.standard_normal((128, 128)), (0, 0), sigma)
        found.append(np.repeat(128 + 30 * field[..., None] / field.std(), 3, axis=2))
    return np.clip(np.stack(found), 0, 255).astype(np.uint8)


def test_auc_is_scikit_learns() -> None:
    rng = np.random.default_rng(0)
    label = rng.integers(0, 2, 60)
    score = np.round(label + rng.normal(0, 1, 60), 1)
    assert cues.auc(score, label) == pytest.approx(roc_auc_score(label, score))
    assert cues.auc(np.zeros(60), label) == 0.5


@pytest.mark.slow
def test_the_classifier_tells_textures_apart_and_not_what_is_the_same() -> None:
    same, other = textured(60, 1.0, 1), textured(60, 2.5, 2)
    label = np.repeat([0, 1], [60, 60])
    fold = np.tile(np.arange(5), 24)
    nothing = np.zeros((120, 120), bool)
    apart = classifier.Split(np.concatenate([same, other]), label, fold, nothing)
    assert classifier.held_out(apart.pictures, apart, 6, 3)["auc"] > 0.95
    alike = classifier.Split(np.concatenate([same, textured(60, 1.0, 5)]), label, fold, nothing)
    assert abs(classifier.held_out(alike.pictures, alike, 6, 3)["auc"] - 0.5) < 0.2


def test_a_crop_that_shows_some_of_a_held_out_one_is_not_trained_on(monkeypatch: pytest.MonkeyPatch) -> None:
    places = np.array([[64.0 * k, 0.0] for k in range(8)])
    near = crops.overlapping(places)
    assert near[0].tolist() == [True, True] + [False] * 6
    split = classifier.Split(textured(8, 1.0, 0), np.array([0, 1] * 4), np.arange(8) // 4, near)
    taught: list[int] = []
    monkeypatch.setattr(classifier, "_trained", lambda pictures, *_: taught.append(len(pictures)))
    monkeypatch.setattr(classifier, "_scores", lambda _, pictures: np.arange(len(pictures)) / 9)
    classifier.held_out(split.pictures, split, 1, 0)
    assert taught == [3, 3], "the fourth and fifth overlap across the border"


def test_shuffled_labels_stay_in_their_fold_and_tell_nothing_on_the_mean() -> None:
    rng = np.random.default_rng(0)
    figures, label = rng.normal(size=(100, 6)), np.repeat([0, 1], [70, 30])
    figures[label == 1] += 3
    split = classifier.Split(textured(1, 1.0, 0), label, np.arange(100) % 5, np.eye(100, dtype=bool))
    assert cues.linear(figures, label, split.fold, split.near) > 0.99
    mixed = [split.shuffled(rng) for _ in range(150)]
    for k in range(5):
        assert mixed[0].label[split.fold == k].sum() == label[split.fold == k].sum()
    found = [cues.linear(figures, one.label, one.fold, one.near) for one in mixed]
    assert np.mean(found) == pytest.approx(0.5, abs=4 * np.std(found) / np.sqrt(150))
    assert 0.03 < np.std(found) < 0.12


def test_every_cue_sees_what_it_is_named_for() -> None:
    import cv2

    rng = np.random.default_rng(1)
    plain = textured(1, 1.0, 1)[0]
    flat = np.full((128, 128, 3), (200, 150, 110), np.uint8)
    at = cues.describe(plain)
    noisy = np.clip(plain + rng.normal(0, 4, plain.shape), 0, 255).astype(np.uint8)
    assert cues.describe(noisy)["noise luma"] > at["noise luma"] + 1
    blurred = cues.describe(cv2.GaussianBlur(plain, (0, 0), 2))
    assert blurred["sharpness luma"] < at["sharpness luma"] - 0.2
    grain = np.clip(flat + rng.normal(0, 4, flat.shape), 0, 255).astype(np.uint8)
    soft = np.clip(flat + 4 * cv2.GaussianBlur(rng.normal(0, 3, flat.shape), (0, 0), 0.8), 0, 255)
    assert (
        cues.describe(soft.astype(np.uint8))["noise neighbours"]
        > cues.describe(grain)["noise neighbours"] + 0.2
    )
    assert cues.describe(grain)["slope fine"] == pytest.approx(0, abs=0.3)
    assert cues.describe(soft.astype(np.uint8))["slope fine"] < -1
    _, packed = cv2.imencode(".jpg", grain, [cv2.IMWRITE_JPEG_QUALITY, 30])
    assert cues.describe(cv2.imdecode(packed, 1))["grid of 8 px"] > 2 * cues.describe(grain)["grid of 8 px"]
    lab = cv2.cvtColor(flat[:1, :1].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0, 0]
    assert [cues.describe(flat)[f"{k} mean"] for k in "Lab"] == pytest.approx(lab, abs=1e-3)
    clipped = flat.copy()
    clipped[:32, :, 0] = 255
    assert cues.describe(clipped)["red clipped"] == 0.25
    assert cues.describe(clipped)["red p99"] == 255


def test_the_farthest_cue_comes_first() -> None:
    figures = np.array([[0.0, 1], [1, 0], [2, 5], [3, 6]])
    rows = classifier.tell_apart(["none", "some"], 2, {"job": figures[[0, 2, 1, 3]][:, ::-1]})
    assert [(row["cue"], row["job, auc"]) for row in rows] == [("some", 0.75), ("none", 0.5)]
    rows = classifier.tell_apart(["one", "two"], 2, {"job": figures})
    assert [row["job, auc"] for row in rows] == [1, 1]
    assert (rows[0]["photograph"], rows[0]["job, median"]) == (0.5, 2.5)


def test_regions_are_apart_and_of_a_size() -> None:
    places = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    region = crops.regions(places, 5)
    assert np.bincount(region).tolist() == [20] * 5
    middles = np.array([places[region == k].mean(axis=0) for k in range(5)])
    nearest = np.linalg.norm(middles[:, None] - middles[None], axis=2)[~np.eye(5, dtype=bool)].min()
    assert nearest > 3


def test_patches_of_the_control_share_a_label() -> None:
    places = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2)
    label = classifier.block_labels(places, np.random.default_rng(0))
    assert 0.3 < label.mean() < 0.7
    grid = label.reshape(20, 20)
    assert (grid[:, 1:] == grid[:, :-1]).mean() > 0.7


def test_distance_counts_in_the_references_spread() -> None:
    rng = np.random.default_rng(0)
    reference = rng.normal(5, [1.0, 10.0, 0.0], (400, 3))
    assert (texture.distances(reference, reference) ** 2).mean() == pytest.approx(1)
    far = reference.mean(axis=0) + np.array([[3 * reference[:, 0].std(), 0, 99]])
    assert texture.distances(far, reference) == pytest.approx([3 / np.sqrt(2)])
    region = np.arange(400) % 5
    assert (texture.own_distances(reference, region) ** 2).mean() == pytest.approx(1, abs=0.05)


def test_a_python_without_plenoptic_is_one_line(tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.write_text(f"#!/bin/sh\nexec {sys.executable} -S -c 'raise ImportError(\"no plenoptic here\")'\n")
    bare.chmod(0o755)
    with pytest.raises(UserError, match=r"plenoptic did not run \(ImportError: no plenoptic here\)"):
        texture.described(textured(1, 1.0, 0), bare)
    with pytest.raises(UserError, match="cannot be run"):
        texture.described(textured(1, 1.0, 0), tmp_path / "none")


def test_the_worker_keeps_crops_in_order(tmp_path: Path) -> None:
    """The worker with a stand-in for plenoptic that gives mean and spread."""
    (tmp_path / "plenoptic.py").write_text(
        "import torch\n"
        "class models:\n"
        "    class PortillaSimoncelli(torch.nn.Module):\n"
        "        def __init__(self, size, n_scales, spatial_corr_width): super().__init__()\n"
        "        def forward(self, x): return torch.stack([x.mean((2, 3)), x.std((2, 3))], -1)\n"
    )
    shim = tmp_path / "py"
    shim.write_text(f'#!/bin/sh\nPYTHONPATH={tmp_path} exec {sys.executable} "$@"\n')
    shim.chmod(0o755)
    pictures = np.stack([np.full((128, 128, 3), level, np.uint8) for level in range(0, 200, 5)])
    found = texture.described(pictures, shim)
    assert found.shape == (40, 2)
    np.testing.assert_allclose(found[:, 0], np.arange(0, 200, 5) / 255, atol=1e-3)
    assert subprocess.run([shim, "-c", "import plenoptic"], check=False).returncode == 0


def test_crops_of_a_photograph_lie_inside_and_are_taken_alike(tmp_path: Path) -> None:
    Image.fromarray(np.full((600, 800, 3), 120, np.uint8)).save(tmp_path / "grey.png")
    found = crops.of_photograph(tmp_path / "grey.png", "0.2,0.2 0.8,0.2 0.8,0.8 0.2,0.8", 80.0, 0.1)
    assert found.pictures.shape[1:] == (128, 128, 3)
    assert found.places.min(axis=0) == pytest.approx([0.2 * 800 + 64, 0.2 * 600 + 64], abs=57)
    assert 0.5 < found.pictures[0].astype(float).std() < 2.5, "noise of 2 levels went through the codec"
    with pytest.raises(UserError, match="no crop of 128 px"):
        crops.of_photograph(tmp_path / "grey.png", "0.2,0.2 0.3,0.2 0.3,0.3", 80.0, 0.1)


@pytest.mark.slow
def test_crops_of_a_job_are_tissue_without_its_tools_and_codec() -> None:
    job = Job.model_validate(
        {
            "sequences": 2,
            "anatomy": {"vertices": 3000},
            "sensor": {"bitrate_mbps": 0.2},
            "render": {"size": [400, 300]},
        }
    )
    found = crops.of_job(job, 0.0547, step=40)
    assert set(found.places[:, 0]) == {0.0, 1.0}
    red, blue = (found.pictures[..., k].astype(float).mean() for k in (0, 2))
    assert red > 1.2 * blue


def test_a_fitted_look_loses_the_light_of_its_own_piece_of_the_photograph(tmp_path: Path) -> None:
    (tmp_path / "look.yaml").write_text("sensor: {vignette: 0.4}\nrender: {size: [640, 480]}\n")
    wide = crops.read_job(tmp_path / "look.yaml", 3, 1, 110.0)
    assert wide.sensor.vignette == pytest.approx(0.4 * (640 * 0.0547 / 110) ** 2)
    assert crops.read_job(tmp_path / "look.yaml", 3, 1, 30.0).sensor.vignette == pytest.approx(0.4)
    assert crops.read_job(None, 3, 1, 110.0).sensor.vignette == Job().sensor.vignette


def test_errors_are_relative_but_for_what_may_be_nothing() -> None:
    known = parameters.start("pale") | {"blur": 1.0, "glare": 0.2}
    found = known | {"density": 1.1, "blur": 0.7, "glare": 0.25, "crown r": 1.2 * known["crown r"]}
    rows = {
        row["parameter"]: row for row in fit.compare("one", known, found, {"density": 0.17, "noise": 0.1})
    }
    assert rows["density"]["error"] == pytest.approx(0.1)
    assert [(rows[k]["sd"], rows[k]["decided"]) for k in ("density", "noise", "vein")] == [
        (0.17, False),
        (0.1, True),
        (None, False),
    ]
    assert (rows["blur"]["error"], rows["glare"]["error"]) == pytest.approx((-0.3, 0.05))
    assert [name for name, row in rows.items() if not row["within_15"]] == ["crown", "glare", "blur"]


def test_the_page_draws_what_is_there(tmp_path: Path) -> None:
    from bench.output import write
    from evidence.look import page as look_page

    row = {"crops": "default job", "count": 9, "p10": 1.0, "median": 1.2, "p90": 1.5, "median_within": True}
    told = {"command": "bench experiment texture x.jpg", "machine": {"cores": 2}}
    write.keep(tmp_path, "texture.json", {**told, "limit_p90_of_photograph": 1.4, "rows": [row]})
    page = look_page.drawn(tmp_path)
    assert [chart.rows[0].name for chart in page.charts] == ["default job"]
    write.keep(tmp_path, "fit.json", {**told, "pictures": [{"picture": "a", "ratio": 0.4}], "parameters": []})
    page = look_page.drawn(tmp_path)
    assert [section.heading for section in page.sections] == ["texture", "fit"]
    assert page.commands == ["bench experiment texture x.jpg"] * 2
