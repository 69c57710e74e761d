from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboardX.proto.event_pb2 import Event
from typer.testing import CliRunner

from learn import checkpoint
from learn.cli import app
from learn.data.clips import Clip
from learn.data.split import Split, nested
from learn.evaluation.evaluate import unseen
from learn.evaluation.metrics import Moments
from learn.inference.predict import load_predictor
from learn.loss import SHARES, Objective
from learn.settings import Settings, preset, replace
from learn.training.batches import Batch, Frames, measure_scales, swayed
from learn.training.gpu_batches import Resident, held
from learn.training.train import moments, select_score, train
from synth.dataset.store import Dataset
from synth.errors import UserError

run = CliRunner().invoke


def small(**changes: object) -> Settings:
    base = preset("tiny", size=32, epochs=4, objective=Objective())
    return replace(base, arch=replace(base.arch, levels=2, dropout=0.1), **changes)


@pytest.fixture(scope="module")
def split(clips: list[Clip]) -> Split:
    return nested(clips, 3, 0, seed=0)


@pytest.fixture(scope="module")
def model(clips: list[Clip], split: Split, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    train(clips, split, small(input="mixed"), out)
    return out


def weights(folder: Path) -> dict[str, torch.Tensor]:
    state: dict[str, torch.Tensor] = checkpoint.load_tensors(folder / "last.pt")["model"]
    return state


class Killed(Exception):
    pass


@pytest.mark.slow
def test_killed_and_resumed_equals_uninterrupted(
    clips: list[Clip], split: Split, model: Path, tmp_path: Path
) -> None:
    def kill(numbers: dict[str, float]) -> None:
        if numbers["epoch"] == 2:
            raise Killed

    out = tmp_path / "model"
    with pytest.raises(Killed):
        train(clips, split, small(input="mixed"), out, log=kill)
    card = train(clips, split, small(input="mixed"), out)
    whole = weights(model)
    for name, value in weights(out).items():
        assert torch.equal(value, whole[name]), name
    assert (out / "history.jsonl").read_text() == (model / "history.jsonl").read_text()
    assert card == checkpoint.read_card(model)


def test_another_seed_is_another_model(clips: list[Clip], split: Split, model: Path, tmp_path: Path) -> None:
    train(clips, split, small(input="mixed", seed=1), tmp_path / "m")
    assert any(not torch.equal(v, weights(model)[k]) for k, v in weights(tmp_path / "m").items())


def test_training_learns(clips: list[Clip], tmp_path: Path) -> None:
    """A network that can't even come to remember what it is shown is broken; one that is stuck loses 0.9."""
    settings = replace(small(epochs=8), batch=4, augment=False, learning_rate=5e-3)
    settings = replace(settings, arch=replace(settings.arch, dropout=0.0))
    train(clips, Split((0, 1, 3, 4, 5, 6), (2,), ()), settings, tmp_path / "m")
    losses = [json.loads(line)["loss"] for line in (tmp_path / "m/history.jsonl").read_text().splitlines()]
    assert losses[-1] < 0.6 < 0.8 < losses[0]


def test_history_reports_loss_and_gradient_shares(model: Path) -> None:
    lines = [json.loads(line) for line in (model / "history.jsonl").read_text().splitlines()]
    assert [line["epoch"] for line in lines] == [1, 2, 3, 4]
    for line in lines:
        assert sum(line[f"share_{name}"] for name in SHARES) == pytest.approx(1)
        assert 0.05 < line["share_r2"] < 0.95


def test_only_unseen_sequences_are_scored(clips: list[Clip], split: Split, model: Path) -> None:
    card = checkpoint.read_card(model)
    assert [c.name for c in unseen(clips, card)] == [clips[i].name for i in split.test]
    copied = dataclasses.replace(clips[split.fit[0]], content_hash="x")
    assert unseen([copied], card) == []


def test_prediction_on_a_picture_is_that_on_the_grid(model: Path, dataset: Path, clips: list[Clip]) -> None:
    predictor = load_predictor(model)
    sequence = Dataset(dataset)[4]
    map_ = predictor(
        sequence["flow"][3],
        sequence["tissue"][:],
        sequence.attrs["scale_mm_per_px"],
        sequence.attrs["young_kpa"],
    )
    on_grid = predictor.density(clips[4].displacement["ideal"][3:4], clips[4].mask, clips[4].young_kpa)[0]
    np.testing.assert_allclose(map_.density, on_grid, rtol=1e-4, atol=1e-7)
    assert map_.force_mn is not None
    assert map_.total_force_mn == pytest.approx(float(np.linalg.norm(map_.force_mn)))
    assert map_.to_image().shape == sequence.size
    assert map_.young_known
    guessed = predictor(sequence["flow"][3], sequence["tissue"][:], sequence.attrs["scale_mm_per_px"])
    assert guessed.young_kpa == predictor.card.typical_young_kpa
    assert guessed.total_force_mn == pytest.approx(
        map_.total_force_mn * guessed.young_kpa / map_.young_kpa, rel=1e-4
    )


def test_the_same_motion_filmed_at_another_resolution_is_the_same_force(model: Path) -> None:
    predictor = load_predictor(model)

    def force(size: int, scale: float) -> float:
        node = (np.arange(size) - (size - 1) / 2) * scale
        x, y = np.meshgrid(node, node)
        tissue = x**2 + y**2 < 11**2
        moved = np.stack([np.exp(-(x**2 + y**2) / 30), 0 * x], axis=-1) * 0.5 / scale
        return predictor((moved * tissue[..., None]).astype(np.float32), tissue, scale, 1.0).total_force_mn

    assert force(240, 0.15) == pytest.approx(force(120, 0.3), rel=0.05)


@pytest.mark.parametrize(
    ("shape", "message"), [((2, 2, 64, 64), r"shape \(T, 2, 32, 32\)"), ((2, 3, 32, 32), "got")]
)
def test_another_grid(model: Path, shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(UserError, match=message):
        load_predictor(model).density(np.zeros(shape, np.float32), np.ones((32, 32), np.float32), 1.0)


def test_bad_numbers(model: Path) -> None:
    predictor = load_predictor(model)
    flow, tissue = np.zeros((8, 8, 2), np.float32), np.ones((8, 8), bool)
    with pytest.raises(UserError, match="young_kpa -1"):
        predictor(flow, tissue, 0.1, -1.0)
    with pytest.raises(UserError, match="flow: expected"):
        predictor(flow[:4], tissue, 0.1)
    with pytest.raises(UserError, match="NaN"):
        predictor(flow * np.nan, tissue, 0.1)


def broken(model: Path, to: Path, file: str, data: bytes) -> Path:
    to.mkdir()
    for item in (f for f in model.iterdir() if f.is_file()):
        (to / item.name).write_bytes(item.read_bytes())
    (to / file).write_bytes(data)
    return to


def test_corrupt_checkpoints(model: Path, tmp_path: Path) -> None:
    whole = (model / "weights.pt").read_bytes()
    with pytest.raises(UserError, match="corrupt checkpoint"):
        load_predictor(broken(model, tmp_path / "a", "weights.pt", whole[: len(whole) // 2]))
    with pytest.raises(UserError, match="corrupt checkpoint"):
        load_predictor(broken(model, tmp_path / "b", "weights.pt", b"not a model"))
    with pytest.raises(UserError, match="corrupt model configuration"):
        load_predictor(broken(model, tmp_path / "c", "config.json", b"{}"))
    config = json.loads((model / "config.json").read_text())
    damaged = {**config, "settings": {**config["settings"], "epochs": "many"}}
    with pytest.raises(UserError, match=r"corrupt model configuration \(settings.epochs: "):
        load_predictor(broken(model, tmp_path / "e", "config.json", json.dumps(damaged).encode()))
    config["settings"]["arch"]["width"] = 8
    del config["seal"]
    with pytest.raises(UserError, match=r"not those of the network in config\.json"):
        load_predictor(broken(model, tmp_path / "d", "config.json", json.dumps(config).encode()))
    with pytest.raises(UserError, match="no model here"):
        load_predictor(tmp_path / "nothing")


def test_a_folder_with_another_run_is_not_overwritten(clips: list[Clip], split: Split, model: Path) -> None:
    before = (model / "weights.pt").read_bytes()
    with pytest.raises(UserError, match="other settings"):
        train(clips, split, small(input="mixed", learning_rate=0.1), model)
    with pytest.raises(UserError, match="other data"):
        train(clips[:-1], nested(clips[:-1], 3, 0, 0), small(input="mixed"), model)
    assert (model / "weights.pt").read_bytes() == before


def test_a_split_that_leaks_is_refused(clips: list[Clip], tmp_path: Path) -> None:
    # Clips 0 and 1 share an anatomy.
    with pytest.raises(UserError, match="shares an anatomy"):
        train(clips, Split((0, 2), (3,), (1,)), small(), tmp_path / "m")


ARGS = ["--preset", "tiny", "--size", "32", "--epochs", "1", "--json"]


@pytest.mark.slow
def test_command_line(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "m"
    done = run(app, ["train", str(dataset), "-o", str(out), "--input", "recovered", *ARGS])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["epoch"] == 1
    done = run(app, ["eval", str(out), str(dataset), "--json"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["input"] == "recovered"
    assert set(result["columns"]) == {"known", "half", "double", "unknown"}
    assert len(result["sequences"]) == len(checkpoint.read_card(out).split["test"])
    table = run(app, ["eval", str(out), str(dataset), "--against", str(out)])
    assert "unseen sequences" in table.output
    shown, paired = " ".join(table.output.split()).split("paired by sequence")
    assert all(unit in part for unit in ("[mN]", "[mN/mm²]", "[mm]") for part in (shown, paired))
    done = run(app, ["eval", str(out), str(dataset), "--against", str(out), "--json"])
    pairs = json.loads(done.stdout)["against"]["paired"]
    assert pairs["map_rmse"]["difference"]["mean"] == 0
    assert pairs["map_rmse"]["p"] == 1
    assert (out / "tensorboard").is_dir()


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--folds", "9"], "9 folds"),
        (["--input", "guessed"], "'input=guessed': input: 'guessed' is not one of 'ideal', 'recovered'"),
        (["--preset", "huge"], "unknown preset 'huge'"),
        (["--size", "40"], "'size=40': size: Input should be a multiple of 16"),
        (["--size", "48", "arch.levels=4"], "input size 48 does not divide by 32"),
        (["--target", "intensity"], "needs output 'magnitude'"),
        (["--hold-out", "calf"], "no sequence of family 'calf'"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    dataset: Path, tmp_path: Path, extra: list[str], message: str
) -> None:
    out = tmp_path / "m"
    done = run(app, ["train", str(dataset), "-o", str(out), *ARGS, *extra])
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not out.exists()


def test_nothing_unseen_is_said_so(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "m"
    run(app, ["train", str(dataset), "-o", str(out), *ARGS])
    card = checkpoint.read_card(out)
    groups = {**card.groups, "fit": [*card.groups["fit"], *card.groups["test"]], "test": []}
    checkpoint.write_card(out, dataclasses.replace(card, groups=groups))
    done = run(app, ["eval", str(out), str(dataset)])
    assert done.exit_code == 2
    assert "--all scores them anyway" in done.stderr


@pytest.mark.parametrize(("output", "confidence"), [("vector", True), ("magnitude", False)])
def test_frames_held_by_the_device_are_the_same_frames(
    clips: list[Clip], output: str, confidence: bool
) -> None:
    settings = small(input="mixed", resident="yes")
    arch = replace(settings.arch, output=output, confidence=confidence)
    settings = replace(settings, arch=arch)
    streamed, there = Frames(clips, settings), held(clips, settings, torch.device("cpu"))
    assert isinstance(there, Resident)
    items = streamed.order(np.random.default_rng(0), 0.5)
    assert items == there.order(np.random.default_rng(0), 0.5)
    turns = {item[3] for item in items[:16]}
    assert len(turns) > 4
    # Alike turned frames stand together, sources in the order of the settings.
    order = sorted(items[:16], key=lambda item: (item[3], streamed.sources.index(item[2])))
    a, b = streamed.batch(order), there.batch(items[:16])
    for name, value in vars(a).items():
        if name == "confidence" and not confidence:
            continue
        torch.testing.assert_close(getattr(b, name), value, rtol=0, atol=0, msg=name)


def test_an_epoch_has_so_many_frames_drawn_anew(clips: list[Clip]) -> None:
    every = Frames(clips, small()).order(np.random.default_rng(0), 1.0)
    some = Frames(clips, small(epoch_frames=5))
    first, second = (some.order(np.random.default_rng(seed), 1.0) for seed in (0, 1))
    assert len(every) > len(first) == 5
    assert len({item[:2] for item in first}) == 5
    assert {item[:2] for item in first} != {item[:2] for item in second}
    assert {item[:2] for item in first} < {item[:2] for item in every}
    assert len(Frames(clips, small(epoch_frames=10_000)).order(np.random.default_rng(0), 1.0)) == len(every)


@pytest.mark.parametrize("window", [1, 3])
def test_sway_moves_the_whole_surface_of_half_of_the_frames_and_leaves_the_force(
    clips: list[Clip], window: int
) -> None:
    settings = small(sway_mm=0.5)
    settings = replace(settings, arch=replace(settings.arch, window=window))
    frames = Frames(clips, settings)
    items = [(c, t, "ideal", 0) for c in range(len(clips)) for t in range(clips[c].frames)]
    still = frames.batch(items)
    moved = swayed(still, settings, torch.Generator().manual_seed(0))
    added = (moved.displacement - still.displacement).abs()
    assert (added * (1 - still.mask)).max() == 0
    touched = added.amax((1, 2, 3)) > 0
    assert 0.2 < touched.float().mean() < 0.8
    size = float((added[touched] ** 2).sum() / (still.mask.expand_as(added)[touched]).sum()) ** 0.5
    assert 0.05 < size < 0.5  # a third of 0.5 mm across the view
    for name in ("mask", "confidence", "target", "force"):
        assert torch.equal(getattr(moved, name), getattr(still, name))
    again = swayed(still, settings, torch.Generator().manual_seed(0))
    assert torch.equal(again.displacement, moved.displacement)


def test_moments_of_tensors_are_those_of_arrays() -> None:
    true, said = np.random.default_rng(0).normal(size=(2, 500)).astype(np.float32)
    got, expected = moments(torch.from_numpy(true), torch.from_numpy(said)), Moments.of(true, said)
    assert dataclasses.astuple(got) == pytest.approx(dataclasses.astuple(expected))


def scalars(folder: Path) -> dict[str, list[int]]:
    """Steps of every scalar in the event files: length, its checksum, the record, its checksum, again and
    again."""
    found: dict[str, list[int]] = {}
    for file in sorted(folder.glob("events*")):
        data = file.read_bytes()
        at = 0
        while at < len(data):
            (size,) = struct.unpack_from("<Q", data, at)
            event = Event.FromString(data[at + 12 : at + 12 + size])
            at += 16 + size
            for value in event.summary.value:
                found.setdefault(value.tag, []).append(event.step)
    return found


def test_tensorboard_gets_every_epoch(model: Path) -> None:
    found = scalars(model / "tensorboard")
    assert found["select/r2"] == [0, 1, 2, 3]
    assert {"loss", "lr", "share/error", "share/ghost"} <= set(found)


def test_training_stops_early(
    clips: list[Clip], split: Split, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = iter([0.1, 0.5, 0.4, 0.3, 0.2])
    monkeypatch.setattr(
        "learn.training.train.select_score", lambda *_: {"select_r2": next(scores), "select_gain": 1.0}
    )
    card = train(clips, split, small(epochs=9, stop=2), tmp_path / "m")
    assert (card.epoch, card.score) == (2, 0.5)
    assert len((tmp_path / "m/history.jsonl").read_text().splitlines()) == 4


def test_no_epoch_is_chosen_before_the_price_of_ghosts_is_whole(
    clips: list[Clip], split: Split, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = iter([0.9, 0.8, 0.1, 0.2])
    monkeypatch.setattr(
        "learn.training.train.select_score", lambda *_: {"select_r2": next(scores), "select_gain": 1.0}
    )
    objective = Objective(kind="hinge", ramp=(0.25, 0.75))
    assert train(clips, split, small(objective=objective), tmp_path / "m").epoch == 4


@pytest.mark.parametrize(
    ("share", "anatomies", "limits"),
    [
        (0.8, 8, (1.0, 1.5)),
        (0.8, 7, (1.0, 1.0)),
        (0.1, 8, (1.5, 1.5)),
        (2.0, 8, (0.67, 0.67)),
        (0.0, 8, (1.0, 1.0)),
    ],
)
def test_what_a_network_says_too_little_of_the_force_is_its_gain(
    clips: list[Clip],
    monkeypatch: pytest.MonkeyPatch,
    share: float,
    anatomies: int,
    limits: tuple[float, float],
) -> None:
    settings = small()
    true, said = [], []

    def forward(_: object, batch: Batch, *__: object) -> tuple[torch.Tensor, None]:
        """Says more of one frame than of another, twice as much on one side, and junk where no tissue is."""
        frames = torch.linspace(0.6, 1.4, len(batch.target))[:, None, None, None]
        side = torch.linspace(1.5, 0.5, settings.size)
        answer = share * frames * side * batch.target
        true.extend((batch.target * batch.mask).sum((2, 3)).flatten().tolist())
        said.extend((answer * batch.mask).sum((2, 3)).flatten().tolist())
        return answer + 9 * (1 - batch.mask), None

    monkeypatch.setattr("learn.training.train.forward", forward)
    told = [dataclasses.replace(clips[i % len(clips)], group=str(i % anatomies)) for i in range(10)]
    chosen = Frames(told, settings)
    found = select_score(torch.nn.Identity(), chosen, measure_scales(clips, settings), torch.device("cpu"))
    slope = np.dot(true, said) / max(np.dot(said, said), 1e-30)
    assert found["select_gain"] == pytest.approx(np.clip(slope, *limits), rel=1e-6)
    if limits == (1.0, 1.5):
        assert 1.0 < slope < 1.5, "within the limits nothing else is tested"


def test_the_kept_epoch_has_its_own_gain(
    clips: list[Clip], split: Split, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = iter(
        [{"select_r2": r2, "select_gain": gain} for r2, gain in ((0.1, 1.4), (0.5, 1.2), (0.4, 1.3))]
    )
    monkeypatch.setattr("learn.training.train.select_score", lambda *_: next(scores))
    assert train(clips, split, small(epochs=3), tmp_path / "m").force_gain == 1.2
    assert checkpoint.read_card(tmp_path / "m").force_gain == 1.2
    assert '"select_gain": 1.3' in (tmp_path / "m/history.jsonl").read_text()
