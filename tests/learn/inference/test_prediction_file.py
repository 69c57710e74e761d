"""Files of `learn predict`: documented fields, equal in all files."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import phantom
import pytest
from command import run
from fake_model import write_model

import learn
from learn.checkpoint import read_card, write_card
from learn.cli import app
from learn.data.grid import GridView, to_image
from learn.inference import prediction_file
from learn.inference.apply import apply
from learn.inference.motion import motions
from learn.inference.predict import load_model
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.system.checked_file import write_picture

FILES = ["000000.force.csv", "000000.force.mp4", "000000.npz"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("predicted")
    phantom.write(folder, 0, anatomy_seed=0)
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"), "arch.output=vector")


def frames(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [one.to_ndarray(format="rgb24") for one in container.decode(video=0)]


def test_a_dataset_gives_the_three_files(data: Path, model: Path, tmp_path: Path) -> None:
    run(app, "predict", model, data, "--out", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == FILES
    sequence = Dataset(data)[0]
    with np.load(tmp_path / "000000.npz") as found:
        assert set(found.files) <= set(prediction_file.FIELDS)
        assert found["scale_mm_per_px"] == pytest.approx(sequence.attrs["scale_mm_per_px"])
        rows = list(csv.DictReader((tmp_path / "000000.force.csv").read_text().splitlines()))
        assert tuple(rows[0]) == prediction_file.COLUMNS
        columns = {"total_force_mn": found["total_force_mn"], "force_y_mn": found["force_mn"][:, 1]}
        for name, values in (columns | {"time_s": sequence["time"][:]}).items():
            assert [float(row[name]) for row in rows] == pytest.approx(values, rel=1e-5), name
    overlay = frames(tmp_path / "000000.force.mp4")
    assert len(overlay) == sequence.frames
    assert overlay[0].shape[0] > sequence.size[0], "the curve lies below the picture"


@pytest.mark.slow
def test_an_array_gives_what_its_pictures_give(data: Path, model: Path, tmp_path: Path) -> None:
    sequence = Dataset(data)[0]
    rgb, tissue = sequence["rgb"][:], sequence["tissue"][:]
    (tmp_path / "frames").mkdir()
    for t, picture in enumerate(rgb):
        write_picture(tmp_path / "frames" / f"{t:03d}.png", picture)
    write_picture(tmp_path / "tissue.png", np.uint8(255) * tissue)
    how: dict[str, Any] = {"scale_mm_per_px": 0.3, "young_kpa": 1.5, "rate_hz": None, "flow": "dis"}
    there = learn.predict(tmp_path / "frames", model, tissue=tmp_path / "tissue.png", masks="none", **how)
    here = learn.predict(rgb, str(model), tissue=tissue, masks="none", fps=25, **how)
    np.testing.assert_array_equal(here["force_mn"], there["force_mn"])
    np.testing.assert_array_equal(here["time_s"], there["time_s"])
    masked = learn.predict(rgb, model, tissue=tissue, masks=sequence["tool"][:], fps=25, **how)
    assert masked["trusted"].all()
    for wrong in ({"tissue": tissue[1:]}, {"masks": sequence["tool"][:2]}, {"membrane": "gone"}):
        with pytest.raises(UserError, match=next(iter(wrong))):
            learn.predict(rgb, model, **{"tissue": tissue, **how, **wrong})


def test_motion_by_another_estimator_than_the_networks_own_is_noted(data: Path, tmp_path: Path) -> None:
    trained = write_model(tmp_path / "model", "arch.output=vector")
    write_card(trained, replace(read_card(trained), motion=["dis 1"]))
    rgb, how = Dataset(data)[0]["rgb"][:], {"scale_mm_per_px": 0.3, "masks": "none"}
    notes = {name: learn.predict(rgb, trained, flow=name, **how)["notes"] for name in ("dis", "tvl1")}
    assert not any("dis 1" in note for note in notes["dis"])
    assert any("dis 1" in note and "tvl1" in note for note in notes["tvl1"])


def test_the_drawn_map_is_the_inverse_of_the_resampling_to_the_grid(data: Path, model: Path) -> None:
    (motion,) = motions(data / "000000.zarr", "ideal")
    predictor = load_model(model)
    found = apply(predictor, motion)
    view = GridView(motion.tissue, motion.scale_mm_per_px, predictor.grid)
    n = predictor.grid.size
    cells = np.exp(-((np.arange(n)[:, None] - 0.6 * n) ** 2 + (np.arange(n) - 0.4 * n) ** 2) / 20)
    place = found["centres_px"][2], float(found["scale_mm_per_px"]), float(found["pitch_mm"])
    there = to_image(cells, motion.tissue.shape, *place)
    whole = np.ones_like(motion.tissue)
    back = GridView(whole, motion.scale_mm_per_px, predictor.grid, view.centre_px).mean(there)
    assert np.abs(back - cells)[view.mask > 0].max() < 0.1
    row, column = (np.average(axis, weights=there) for axis in np.indices(there.shape))
    x, y = found["centres_px"][2]
    step = found["pitch_mm"] / found["scale_mm_per_px"]
    assert column == pytest.approx(x + (0.4 * n - (n - 1) / 2) * step, abs=1.0)
    assert row == pytest.approx(y + (0.6 * n - (n - 1) / 2) * step, abs=1.0)
