"""Networks that come with the package: listed, named, and taken where nobody names any."""

from __future__ import annotations

import json
from pathlib import Path

import fake_model
import numpy as np
import pytest
from fake_recording import Maker
from typer.testing import CliRunner

import bench
import learn
from bench.cli import app as bench_app
from learn import checkpoint
from learn.cli import app
from learn.inference import shipped
from synth.dataset.store import Dataset
from synth.errors import UserError

run = CliRunner().invoke


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where networks that come along lie: none yet."""
    monkeypatch.setattr(shipped, "MODELS", tmp_path / "models")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "models"


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    return Maker(tmp_path)


def pack(models: Path, name: str, *changes: str) -> Path:
    """A tiny one, as if it had come along."""
    source = fake_model.write_model(models.parent / f"trained-{name}", *changes)
    shipped.pack_model(source, models / name, "c0ffee", {"error": "12% of the peak"}, ["It is for tests."])
    return models / name


def test_without_any_the_commands_say_so(models: Path, make: Maker) -> None:
    listed = run(app, ["models"])
    assert (listed.exit_code, listed.stdout) == (0, f"{shipped.NONE}\n")
    assert json.loads(run(app, ["models", "--json"]).stdout) == []
    for words, told in (
        (["predict", "video.mp4"], "say the model's folder"),
        (["predict", "mono", "video.mp4"], "mono: no such folder"),
        (["export", "stereo", "net.pt"], "stereo: no such folder"),
    ):
        done = run(app, words)
        assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1), done.output
        assert told in done.stderr
        assert "learn train" in done.stderr
    done = run(bench_app, ["score", str(make(frames=12)), "-o", "out"])
    assert done.exit_code == 2
    assert "say --model: no trained network comes with this version" in done.stderr
    assert not Path("out").exists()


def test_what_is_packed_is_the_model(models: Path) -> None:
    folder = pack(models, "mono", "arch.output=vector", "arch.prior=residual")
    assert sorted(path.name for path in folder.iterdir()) == [
        "README.md",
        "config.json",
        "weights.safetensors",
    ]
    both = (models.parent / "trained-mono", folder)
    before, after = (checkpoint.load_model(one)[0].state_dict() for one in both)
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    page, card = (folder / "README.md").read_text(), checkpoint.read_card(folder)
    for told in (shipped.hash_data(card), "c0ffee", "| error | 12% of the peak |", "- It is for tests."):
        assert told in page
    listed = run(app, ["models"]).stdout.splitlines()
    assert len(listed) == 1
    assert listed[0].startswith("mono: one eye, vector, 32² cells")
    (row,) = json.loads(run(app, ["models", "--json"]).stdout)
    assert (row["name"], row["eyes"], row["bytes"]) == ("mono", 1, shipped.size_bytes(folder))


def test_damage_is_found(models: Path) -> None:
    weights = pack(models, "mono") / "weights.safetensors"
    whole = weights.read_bytes()
    for broken, told in ((whole[:-100], "corrupt checkpoint"), (whole[:-1] + b"\x7f", "not the weights")):
        weights.write_bytes(broken)
        with pytest.raises(UserError, match=told):
            learn.load_model("mono")


def test_one_that_is_too_large_is_refused(models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped, "LARGEST_BYTES", 10_000)
    with pytest.raises(UserError, match="a smaller arch"):
        pack(models, "mono")
    assert not (models / "mono").exists()


def test_its_name_is_taken_where_a_folder_is(models: Path, dataset: Path, make: Maker) -> None:
    pack(models, "mono", "arch.output=vector")
    assert learn.load_model("mono").card == checkpoint.read_card(models / "mono")
    store = Dataset(dataset)[0].path
    for words in (["mono", str(store)], [str(store)]):
        done = run(app, ["predict", *words, "-o", f"said-{len(words)}", "--no-overlay", "--json"])
        assert done.exit_code == 0, done.output
    one, two = (np.load(next(Path(f"said-{n}").glob("*.npz"))) for n in (1, 2))
    assert np.array_equal(one["density"], two["density"])
    assert run(app, ["export", "mono", "net.pt"]).exit_code == 0
    recording, quick = make(frames=12), bench.Settings(backend="dis")
    named = bench.score(recording, "mono", baselines=False, settings=quick)
    unnamed = bench.score(recording, baselines=False, settings=quick)
    assert np.array_equal(named.methods["D2FNet"].size_mn, unnamed.methods["D2FNet"].size_mn)
    # What comes along is nobody's to change.
    done = run(app, ["intervals", "mono", str(dataset)])
    assert (done.exit_code, Path("mono").exists()) == (2, False), done.output


def test_a_folder_of_that_name_comes_first(models: Path, tmp_path: Path) -> None:
    pack(models, "mono")
    mine = fake_model.write_model(tmp_path / "mono", "arch.output=vector")
    assert learn.load_model("mono").card == checkpoint.read_card(mine)


def test_two_eyes_take_the_network_of_two(models: Path) -> None:
    assert shipped.choose_model(two_eyes=True) is None
    mono = pack(models, "mono")
    assert shipped.choose_model(two_eyes=True) == shipped.choose_model(two_eyes=False) == mono
    stereo = pack(models, "stereo", "arch.depth=true", "input=motion", "arch.output=vector")
    assert shipped.choose_model(two_eyes=True) == stereo
    assert shipped.choose_model(two_eyes=False) == mono


def test_a_live_video_is_given_forces_once_its_scale_is_known(models: Path, make: Maker) -> None:
    pack(models, "mono", "arch.output=vector")
    video = make(frames=12, footage="mp4") / "video.mp4"
    plain = run(bench_app, ["live", str(video), "--every", "--flow", "dis"])
    assert plain.exit_code == 0, plain.output
    assert "mN" not in plain.stdout
    forced = run(bench_app, ["live", str(video), "--every", "--flow", "dis", "--scale", "0.1"])
    assert "mN" in forced.stdout


@pytest.mark.parametrize("name", shipped.NAMES)
def test_what_lies_there_is_small_whole_and_told_of(name: str) -> None:
    if name not in shipped.shipped():
        pytest.skip("none comes with this version")
    folder = shipped.MODELS / name
    assert shipped.size_bytes(folder) <= shipped.LARGEST_BYTES == 4_000_000
    card = learn.load_model(name).card
    assert card.settings.arch.depth == (name == "stereo")
    page = (folder / "README.md").read_text()
    assert shipped.hash_data(card) in page
    assert "Limits:" in page
