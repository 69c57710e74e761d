"""Models from strangers and from damaged disks: card and weights are read, or refused in one line."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fake_model
import foreign
import numpy as np
import phantom
import pytest
import torch
from hostile import Guard, assert_told, cases
from hypothesis import strategies as st
from typer.testing import CliRunner

from learn import checkpoint
from learn.checkpoint import load_model, load_tensors, read_card, write_card, write_model
from learn.cli import app
from learn.data.clips import Clip
from learn.data.split import Split
from learn.inference.predict import load_predictor
from learn.settings import preset, replace
from learn.training.train import train
from synth.errors import Caution, UserError
from synth.job import identity

run = CliRunner().invoke


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model and a store that it answers to."""
    root = tmp_path_factory.mktemp("pristine")
    phantom.write(root, 0, anatomy_seed=1, frames=3)
    fake_model.write_model(root / "model")
    return root


@pytest.fixture
def model(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine / "model", tmp_path / "model"))


@pytest.fixture(scope="module")
def guard() -> Iterator[Guard]:
    with Guard("learn.inference.apply", "torch.jit") as started:
        yield started


def reseal(folder: Path, tree: dict[str, Any]) -> None:
    """Makes this the card, with a seal as a stranger would make it."""
    tree.pop("seal", None)
    try:
        tree["seal"] = checkpoint._hash(identity.canonical(tree))
    except ValueError:
        tree["seal"] = "0" * 32
    (folder / "config.json").write_text(json.dumps(tree))


def calibrated(model: Path, store: Path) -> list[str]:
    return ["calibrate", str(model), str(store / "000000.zarr")]


@pytest.mark.parametrize(
    ("at", "value", "wrong"),
    [
        (("scales", "displacement_mm"), 0, "scales.displacement_mm: Input should be greater than 0"),
        (("scales", "target"), -1000, "scales.target: Input should be greater than 0"),
        (("scales", "divergence"), float("inf"), "scales.divergence: Input should be a finite number"),
        (("scales", "force"), float("nan"), "scales.force: Input should be"),
        (("scales", "spread"), "1", "scales.spread: Input should be a valid number"),
        (("typical_young_kpa",), 0, "typical_young_kpa: Input should be greater than 0"),
        (("settings", "arch", "width"), 10**9, "settings.arch.width: Input should be less than"),
        (("settings", "arch", "levels"), 99, "settings.arch.levels: Input should be less than"),
        (("settings", "size"), 2**20, "settings.size: Input should be less than"),
        (("settings", "batch"), True, "settings.batch: Input should be a valid integer"),
        (("settings", "extent_mm"), 1e300, "settings.extent_mm: Input should be less than"),
        (("split",), ["fit"], "split: Input should be an object"),
        (("epoch",), -1, "epoch: Input should be greater than"),
        (("score",), float("-inf"), "score: Input should be a finite number"),
    ],
    ids=str,
)
def test_a_card_that_cant_be_right(
    model: Path, pristine: Path, at: foreign.Place, value: object, wrong: str
) -> None:
    reseal(model, foreign.edit(json.loads((model / "config.json").read_text()), [(at, value)]))
    done = run(app, calibrated(model, pristine))
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert f"config.json: corrupt model configuration ({wrong}" in done.stderr


@pytest.mark.parametrize(
    "text",
    ["", "[]", "7", "{", "\x00", "[" * 100_000, '{"a":' * 100_000, '{"format": "sulcus-model"}', "\udcff"],
)
def test_a_card_that_is_none(model: Path, pristine: Path, text: str) -> None:
    (model / "config.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    done = run(app, calibrated(model, pristine))
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert "config.json: corrupt model configuration (" in done.stderr


def test_an_edited_card_is_refused(model: Path) -> None:
    text = (model / "config.json").read_text()
    (model / "config.json").write_text(text.replace('"typical_young_kpa": 1.7', '"typical_young_kpa": 17'))
    with pytest.raises(UserError, match=r"config\.json: is not as it was written: edited or damaged"):
        load_model(model)


def test_every_flipped_bit_of_the_weights_is_found(model: Path) -> None:
    whole = (model / "weights.pt").read_bytes()
    rng = np.random.default_rng(0)
    for at in rng.integers(len(whole), size=40):
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        (model / "weights.pt").write_bytes(data)
        with pytest.raises(
            UserError, match=r"corrupt checkpoint|not the weights that config\.json was written"
        ):
            load_model(model)


def test_weights_of_another_model_are_refused(model: Path, tmp_path: Path) -> None:
    other = fake_model.write_model(tmp_path / "other", "arch.dropout=0.1")
    state = {name: value + 0.5 for name, value in load_tensors(other / "weights.pt").items()}
    write_model(other, read_card(other), state)
    shutil.copy(other / "weights.pt", model)
    with pytest.raises(UserError, match=r"weights\.pt: not the weights that config\.json was written for"):
        load_model(model)


def old(model: Path) -> Path:
    """The folder as it was written before there were hashes."""
    tree = json.loads((model / "config.json").read_text())
    del tree["seal"], tree["weights_hash"]
    (model / "config.json").write_text(json.dumps(tree))
    return model


@pytest.mark.filterwarnings("always::synth.errors.Caution")
def test_a_folder_of_before_is_read_with_a_note(model: Path, pristine: Path) -> None:
    now = run(app, [*calibrated(model, pristine), "--json"])
    done = run(app, [*calibrated(old(model), pristine), "--json"])
    assert (done.exit_code, done.stdout) == (0, now.stdout)
    assert done.stderr.splitlines() == [
        f"note: {model}: was made before models had hashes: nothing shows whether its card was edited"
    ]


def test_flipped_bits_in_weights_of_before_are_found_all_the_same(model: Path) -> None:
    """By the archive's own checksums, which PyTorch doesn't look at."""
    with zipfile.ZipFile(model / "weights.pt") as archive:
        entry = max(archive.infolist(), key=lambda one: one.file_size)
    data = bytearray((model / "weights.pt").read_bytes())
    data[entry.header_offset + 200 + entry.file_size // 2] ^= 64
    (model / "weights.pt").write_bytes(data)
    assert torch.load(model / "weights.pt", weights_only=True), "PyTorch has come to look at checksums"
    with pytest.raises(UserError, match=r"corrupt checkpoint \(a checksum of .* does not match\)"):
        load_model(old(model))


def test_a_kill_between_card_and_weights_leaves_a_model(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = {name: value * 2 for name, value in load_tensors(model / "weights.pt").items()}
    card = read_card(model)
    for dies_at in ("write_card", "os.replace"):
        before = {name: value.clone() for name, value in load_model(model)[0].state_dict().items()}

        def die(*_: object) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(f"learn.checkpoint.{dies_at}", die)
            if dies_at == "os.replace":
                patch.setattr("learn.checkpoint._write", lambda file, data: file.write_bytes(data))
            with pytest.raises(KeyboardInterrupt):
                write_model(model, card, state)
        there = load_model(model)[0].state_dict()
        expected = before if dies_at == "write_card" else state
        assert all(torch.equal(there[name], value) for name, value in expected.items())


def bomb(file: Path) -> None:
    """Weights of 40 GB in a few hundred bytes: one number, seen again and again."""
    torch.save({"x": torch.zeros(1).expand(10_000_000_000)}, file)


def packed(file: Path) -> None:
    """An archive of zeros that is a thousand times larger in memory."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("weights/data.pkl", bytes(50_000_000))


def other_names(file: Path) -> None:
    torch.save({"x": torch.zeros(3)}, file)


def no_tensors(file: Path) -> None:
    torch.save({"x": 3, "y": [1]}, file)


def no_state(file: Path) -> None:
    torch.save([1], file)


def code(file: Path) -> None:
    torch.save({"x": print}, file)


@pytest.mark.parametrize(
    "make", [bomb, packed, other_names, no_tensors, no_state, code], ids=lambda f: f.__name__
)
def test_weights_that_are_none(guard: Guard, model: Path, pristine: Path, make: Any) -> None:
    make(model / "weights.pt")
    card = read_card(model)
    data = (model / "weights.pt").read_bytes()
    tree = json.loads((model / "config.json").read_text())
    assert card.weights_hash == tree["weights_hash"]
    reseal(model, tree | {"weights_hash": checkpoint._hash(data)})
    answer = guard.answer("learn", *calibrated(model, pristine))
    assert answer.code == 2
    assert_told(answer)


def test_an_answer_that_is_no_number_is_an_error(model: Path, pristine: Path) -> None:
    card = read_card(model)
    scales = card.scales.__class__(1.0, 0.2, 3e38, 100.0, 0.3)
    state = load_tensors(model / "weights.pt")
    write_model(model, checkpoint.replace(card, scales=scales, typical_young_kpa=1e6), state)
    done = run(app, calibrated(model, pristine))
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert "the model answers NaN or infinity: its weights or scales can't be right" in done.stderr
    with pytest.raises(UserError, match="answers NaN or infinity"):
        load_predictor(model)(np.ones((48, 64, 2), np.float32), np.ones((48, 64), bool), 0.5)


# ---- room on the disk

ARGS = ["--preset", "tiny", "--size", "32", "--epochs", "1", "--json"]


@pytest.mark.parametrize("below", [False, True])
def test_an_output_that_is_a_file_is_found_before_the_work(tmp_path: Path, below: bool) -> None:
    (tmp_path / "m").write_text("mine")
    out = tmp_path / "m" / "model" if below else tmp_path / "m"
    done = run(app, ["train", str(tmp_path / "no-dataset"), "-o", str(out), *ARGS])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert f"{out}: a file is in the way of this folder" in done.stderr
    assert (tmp_path / "m").read_text() == "mine"


@pytest.fixture
def full() -> Iterator[None]:
    """A disk on which no file grows beyond 50 kB."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.usefixtures("full")
def test_a_full_disk_is_found_before_the_work(tmp_path: Path) -> None:
    done = run(app, ["train", str(tmp_path / "no-dataset"), "-o", str(tmp_path / "m"), *ARGS])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert "m: cannot be written (File too large)" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("full")
def test_a_disk_that_fills_up_leaves_nothing(clips: list[Clip], tmp_path: Path) -> None:
    base = preset("tiny", size=32, epochs=1)
    settings = replace(base, arch=replace(base.arch, levels=2))
    with pytest.raises(UserError, match=r"weights\.next\.pt: cannot be written \(File too large\)"):
        train(clips, Split((0, 1), (2,), ()), settings, tmp_path / "m")
    assert list(tmp_path.iterdir()) == []


# ---- drawn cases

PLACES = {
    "format": "",
    "version": 1,
    "settings": {
        "size": 0,
        "extent_mm": 0,
        "batch": 0,
        "input": "",
        "target": "",
        "arch": {
            "name": "",
            "width": 0,
            "levels": 0,
            "stem": 0,
            "bounds": [0, 0],
            "condition": "",
            "total": "",
        },
        "objective": {"kind": "", "low": 0},
    },
    "scales": {"displacement_mm": 0, "divergence": 0, "target": 0, "force": 0, "spread": 0},
    "typical_young_kpa": 0,
    "split": {"fit": [""]},
    "groups": {"fit": [""]},
    "epoch": 0,
    "weights_hash": "",
    "extra": 0,
}


def check_card(guard: Guard, pristine: Path, changes: list[tuple[foreign.Place, Any]], sealed: bool) -> None:
    model = pristine / "edited"
    shutil.rmtree(model, ignore_errors=True)
    shutil.copytree(pristine / "model", model)
    tree = foreign.edit(json.loads((model / "config.json").read_text()), changes)
    if sealed:
        reseal(model, tree)
    else:
        (model / "config.json").write_text(json.dumps(tree))
    assert_told(guard.answer("learn", *calibrated(model, pristine)))


@cases(changes=foreign.edits(PLACES), sealed=st.booleans())
def test_a_card_of_any_kind(
    guard: Guard, pristine: Path, changes: list[tuple[foreign.Place, Any]], sealed: bool
) -> None:
    check_card(guard, pristine, changes, sealed)


@pytest.mark.slow
@cases(slow=True, changes=foreign.edits(PLACES), sealed=st.booleans())
def test_a_card_of_any_kind_at_length(
    guard: Guard, pristine: Path, changes: list[tuple[foreign.Place, Any]], sealed: bool
) -> None:
    check_card(guard, pristine, changes, sealed)


def test_the_note_is_a_warning_that_programs_can_hear(model: Path) -> None:
    with pytest.warns(Caution, match="made before models had hashes"):
        load_model(old(model))
    write_card(model, read_card(model))
    with pytest.raises(UserError, match="not the weights"):
        load_model(model)
