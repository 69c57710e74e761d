"""Photographs as they come: what is masked, what is refused, what their packing says."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from synth.cli import app
from synth.errors import UserError
from synth.fit.compression import Compression
from synth.fit.photograph import read_photograph, usual_mm_per_px
from synth.fit.region import find_cortex

REFERENCE = Path(__file__).parents[4] / "shared" / "reference" / "cortex_photo.jpg"


def scene(width: int = 640, height: int = 480, *, tool: bool = True) -> np.ndarray:
    """An opening of tissue in a bloody rim on a dark blue drape, with a steel rod across it (H, W, 3)."""
    rng = np.random.default_rng(0)
    picture = np.full((height, width, 3), (20, 25, 60), np.uint8)
    centre = (width // 2, height // 2)
    cv2.circle(picture, centre, round(0.46 * height), (130, 25, 20), -1)
    cv2.circle(picture, centre, round(0.38 * height), (240, 205, 160), -1)
    for angle in np.linspace(0, np.pi, 9)[:-1]:
        reach = 0.36 * height * np.array([np.cos(angle), np.sin(angle)])
        ends = [tuple(np.rint(np.array(centre) + sign * reach).astype(int).tolist()) for sign in (-1, 1)]
        cv2.line(picture, ends[0], ends[1], (200, 70, 55), 3)
    if tool:
        cv2.line(picture, (width, height), (width // 2 + 40, height // 2 + 30), (150, 152, 155), 26)
    return np.clip(picture + rng.normal(0, 3, picture.shape), 0, 255).astype(np.uint8)


def opening(width: int = 640, height: int = 480) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.asarray(np.hypot(x - width // 2, y - height // 2) < 0.38 * height)


def written(path: Path, rgb: np.ndarray, **how: object) -> Path:
    Image.fromarray(rgb).save(path, **how)
    return path


def test_the_opening_is_found_and_the_instrument_left_out() -> None:
    with_tool, truth = find_cortex(scene(), 0.08), opening()
    rod = np.zeros(truth.shape, np.uint8)
    cv2.line(rod, (640, 480), (360, 270), 1, 20)
    rod = (rod > 0) & truth
    assert (with_tool & rod).sum() < 0.1 * rod.sum()
    assert (with_tool & ~truth).sum() < 0.03 * truth.sum()
    assert (with_tool & truth).sum() > 0.6 * (truth & ~rod).sum()
    assert (find_cortex(scene(tool=False), 0.08) & truth).sum() > 0.8 * truth.sum()


def test_a_picture_of_no_cortex_has_none() -> None:
    assert not find_cortex(np.zeros((300, 400, 3), np.uint8), 0.1).any()
    assert not find_cortex(np.full((300, 400, 3), (20, 25, 90), np.uint8), 0.1).any()


def test_a_photograph_is_brought_to_the_jobs_scale_and_cut(tmp_path: Path) -> None:
    file = written(tmp_path / "photo.png", scene(1280, 960))
    width = 1280 * usual_mm_per_px() / 2
    found = read_photograph(file, width, None)
    assert found.view.mm_per_px == pytest.approx(usual_mm_per_px())
    assert found.compression.finer == pytest.approx(2)
    assert found.view.rgb.shape[0] < 480
    assert found.view.usable.any(axis=0).all()
    assert found.view.corner2.min() < 0.01
    assert found.view.corner2.max() < 0.5, "corners are those of the whole photograph"


def test_a_coarse_photograph_stays_as_it_is(tmp_path: Path) -> None:
    found = read_photograph(written(tmp_path / "photo.png", scene()), 80.0, None)
    assert found.view.mm_per_px == pytest.approx(80 / 640)
    assert found.compression == Compression()


def test_a_mask_by_hand_is_taken(tmp_path: Path) -> None:
    photo = written(tmp_path / "photo.png", scene())
    mask = np.zeros((480, 640), np.uint8)
    mask[200:300, 250:390] = 255
    found = read_photograph(photo, 60.0, written(tmp_path / "mask.png", mask))
    assert found.view.usable.shape == (100, 140)
    assert found.view.usable.all()


def test_the_tables_of_a_jpeg_are_read_and_pack_alike() -> None:
    rgb = scene()
    packed = io.BytesIO()
    Image.fromarray(rgb).save(packed, "JPEG", quality=60, subsampling="4:2:0")
    found = Compression.of_file(packed.getvalue(), 1.0)
    assert found.chroma == "4:2:0"
    once = np.asarray(Image.open(io.BytesIO(packed.getvalue())))
    assert np.abs(found.apply(rgb).astype(int) - once).mean() < 0.05
    fine = Compression(found.tables, found.chroma, 2.0)
    lost = [np.abs(one.apply(rgb).astype(float) - rgb).mean() for one in (found, fine)]
    assert lost[1] < 0.8 * lost[0], "at twice the pixels the same tables take less"


def test_a_rate_is_found_that_takes_as_much_and_none_for_what_was_not_packed() -> None:
    rgb, tables = scene(320, 240), {}
    for quality in (30, 85):
        packed = io.BytesIO()
        Image.fromarray(rgb).save(packed, "JPEG", quality=quality)
        tables[quality] = Compression.of_file(packed.getvalue(), 1.0).bitrate_mbps(rgb)
    assert Compression().bitrate_mbps(rgb) is None
    assert tables[30] is not None
    assert tables[85] is None or tables[30] < tables[85]


def test_a_picture_that_holds_too_little_is_refused(tmp_path: Path) -> None:
    dark = written(tmp_path / "dark.png", np.zeros((300, 400, 3), np.uint8))
    with pytest.raises(
        UserError, match=r"dark.png: 0 mm2 of cortex in a width of 35 mm, 60 are needed; mark it"
    ):
        read_photograph(dark, 35.0, None)
    small = written(tmp_path / "small.png", scene(200, 150))
    with pytest.raises(UserError, match=r"200 x 150 pixels; at least 160 each way"):
        read_photograph(small, 35.0, None)
    photo = written(tmp_path / "photo.png", scene())
    mask = written(tmp_path / "mask.png", np.zeros((300, 400), np.uint8))
    with pytest.raises(UserError, match=r"mask.png: is 400 x 300 pixels, the photograph 640 x 480"):
        read_photograph(photo, 35.0, mask)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["none.jpg"], "none.jpg: no such file"),
        (["text.jpg"], "text.jpg: not a readable picture"),
        (["photo.png", "-o", "text.jpg"], "text.jpg: exists already"),
        (["photo.png", "-o", "nowhere/look.yaml"], "its folder does not exist"),
        (["photo.png", "--sheet", "nowhere/x.png"], "its folder does not exist"),
        (["photo.png", "--sheet", "x.what"], "x.what: is no name of a picture"),
    ],
)
def test_bad_input_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.jpg").write_text("no picture")
    written(Path("photo.png"), scene())
    done = CliRunner().invoke(app, ["fit", *words])
    assert done.exit_code != 0
    told = done.output + str(done.exception or "")
    assert said in told
    assert not Path("look.yaml").exists()


@pytest.mark.skipif(not REFERENCE.exists(), reason="the reference photograph is not at hand")
def test_the_cortex_of_the_reference_photograph_is_found(tmp_path: Path) -> None:
    photo = Path(shutil.copy(REFERENCE, tmp_path / "photo.jpg"))
    found = read_photograph(photo, 110.0, None)
    area = found.view.usable.sum() * found.view.mm_per_px**2
    assert 1200 < area < 2400, "the opening is some 55 mm wide"
    red, green = (found.view.rgb[..., k][found.view.usable].astype(float) for k in range(2))
    assert np.mean(green < 0.42 * red) < 0.15, "little of it is blood"
