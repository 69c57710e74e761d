"""Card, pictures and views of a dataset agree with it and can be read by others."""

import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run
from PIL import Image
from ruamel.yaml import YAML

from synth.cli import app
from synth.dataset import index
from synth.dataset.dataset_folder import Folder
from synth.dataset.store import Dataset
from synth.publish import card, picture


def test_the_card_agrees_with_the_dataset(root: Path) -> None:
    text = (root / "README.md").read_text("utf-8")
    front_matter = YAML(typ="safe").load(text.split("---")[1])
    assert (front_matter["pretty_name"], front_matter["license"]) == ("Pulls: a test", "cc-by-4.0")
    assert (root / front_matter["configs"][0]["data_files"][0]["path"]).is_file()
    for name in [*Dataset(root)[0].fields, *index.SCHEMA.names]:
        assert f"| `{name}` |" in text
    stiffness = [row["young_kpa"] for row in index.read_index(root).to_pylist()]
    line = next(line for line in text.splitlines() if line.startswith("| Young's modulus"))
    cells = [float(cell) for cell in line.split("|")[2:5]]
    assert cells == pytest.approx([min(stiffness), np.median(stiffness), max(stiffness)], rel=5e-3)
    # All pictures shown and all files named in it exist.
    for names in re.findall(r"\]\((\S+)\)|`(\w+\.(?:json|parquet|yaml|mp4))`", text):
        assert (root / (names[0] or names[1])).is_file(), names


def test_the_card_counts_sequences_that_were_drawn_anew(root: Path) -> None:
    rows = index.read_index(root).to_pylist()
    for attempts in ([], [1], [1, 3]):
        redrawn_rows = [row | {"attempt": k} for row, k in zip(rows, attempts, strict=False)]
        assert card.facts(Folder(root), redrawn_rows + rows[len(redrawn_rows) :])["redrawn"] == len(attempts)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_the_folder_loads_with_datasets(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "HF_HUB_OFFLINE", "1")
    monkeypatch.setitem(os.environ, "HF_HOME", str(tmp_path))
    import datasets

    table = datasets.load_dataset(str(root), split="index", cache_dir=str(tmp_path))
    assert table["index"][:] == list(range(6))
    assert set(index.SCHEMA.names) <= set(table.column_names)


def test_a_picture_shows_flow_and_load_where_they_are(root: Path, tmp_path: Path) -> None:
    sequence = Dataset(root)[0]
    drawing = picture.draw_sequence(sequence, [0, picture.find_strongest(sequence)])
    height, width = sequence.size
    assert drawing.shape == (2 * (height + 26), 3 * width + 12, 3)
    load = np.linalg.norm(sequence["traction"][2], axis=-1)
    pixel = np.unravel_index(load.argmax(), load.shape)
    force = drawing[-height:, -width:]
    red, _, blue = force[pixel].astype(int)
    assert red > blue + 50, "yellow at the greatest load"
    assert np.array_equal(drawing[-height:, :width], sequence["rgb"][2])
    words = ["view", root, "--frame", 0, "-f", picture.find_strongest(sequence), "--save"]
    run(app, *words, tmp_path / "two.png")
    assert np.array_equal(np.asarray(Image.open(tmp_path / "two.png")), drawing)
    run(app, *words, tmp_path / "two.txt", code=2)
    run(app, "view", root, "--save", tmp_path / "all.webp")
    with Image.open(tmp_path / "all.webp") as animation:
        assert (animation.n_frames, animation.size) == (
            sequence.frames,
            (drawing.shape[1], drawing.shape[0] // 2),
        )


@pytest.mark.slow
def test_preview_draws_scenarios_and_prints_their_disk(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    settings = ["render.size=[80, 64]", "sequences=40", "frames=6", "render.spp=4", "anatomy.vertices=900"]
    result = run(app, "preview", "tiny", *settings, "-n", 3, "-o", sheet, "--json")
    summary = json.loads(result.stdout)
    assert cv2.imread(str(sheet)).shape == (128, 160, 3)  # three tiles in a square of four
    assert summary["disk_bytes"] > 40 * 6 * 80 * 64 * 3 / 2
