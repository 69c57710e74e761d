"""Reference numbers of the whole pipeline, to compare a change of the code against.

    python tests/helpers/guard.py FOLDER                     every case, written to FOLDER/guard.json
    python tests/helpers/guard.py FOLDER --against guard.json    also every number and hash that differs

`tests/golden/guard.json` holds the numbers that `test_guard.py` expects. They carry over between processors
within the tolerances stated there; hashes (of stored fields and of weights) only compare runs on one machine.
"""

import argparse
import hashlib
import json
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner

Numbers = dict[str, list[float]]
"""Name of a quantity -> mean and maximum of its absolute values."""

SMALL = ["frames=4", "anatomy.vertices=1500", "fem.tets=400", "render.size=[64,48]", "fem.load=[0.1,0.3]"]
MONO = ["sequences=1", "seed=5", "frames=8", "fps=8", "render.size=[96,72]"]
PAIR = ["sequences=1", "seed=3", "frames=6", "fps=6", "render.size=[96,72]", "render.stereo_mm=24"]
PAIR += ["fem.membrane.probability=1.0", "fem.pulse.heart_mm=[0.2,0.2]", "fem.pulse.breath_mm=[0.3,0.3]"]
MOVING = ["sequences=1", "seed=9", "frames=8", "fps=8", "render.size=[96,72]", "render.drift_mm=[0.8,0.8]"]
NETWORK = ["--preset", "tiny", "--epochs", "1", "size=16", "arch.width=4", "arch.levels=2"]


def run(package: str, *words: str | Path) -> None:
    """Runs a command in this process. Raises RuntimeError with its output if it fails."""
    done = CliRunner().invoke(import_module(f"{package}.cli").app, [str(word) for word in words])
    if done.exit_code:
        raise RuntimeError(f"{package} {words}: {done.output} {done.exception!r}")


def mean_and_maximum(values: Any) -> list[float]:
    size = np.abs(np.asarray(values, np.float64))
    return [float(size.mean()), float(size.max())]


def render(folder: Path, job: Sequence[str]) -> Path:
    """A dataset of a small job with changes, rendered once."""
    from synth.engine.run import open_dataset
    from synth.job.reader import load_job
    from synth.sequence.pipeline import write_scene
    from synth.sequence.simulation import simulate

    if not folder.exists():
        loaded = load_job("tiny", [*SMALL, *job])
        with open_dataset(folder, loaded) as root:
            for index in range(loaded.sequences):
                write_scene(simulate(loaded, index), root)
    return folder


def sequence(folder: Path) -> tuple[Numbers, dict[str, str]]:
    from synth.dataset.store import open_sequence

    stored = open_sequence(folder / "000000.zarr")
    hashes = dict(stored.attrs["field_hashes"])
    return {name: mean_and_maximum(stored[name][:]) for name in sorted(hashes)}, hashes


def epoch(work: Path) -> tuple[Numbers, dict[str, str]]:
    """One epoch of training: its losses, and what the network then answers."""
    import torch

    from learn import checkpoint

    data = render(work / "fitted", ["sequences=6", "seed=7"])
    run("learn", "train", data, "-o", work / "model", *NETWORK)
    losses = [json.loads(line) for line in (work / "model/history.jsonl").read_text().splitlines()]
    model, _ = checkpoint.read_model(work / "model")
    given = torch.linspace(-1, 1, 16 * 16).reshape(1, 1, 16, 16)
    with torch.no_grad():
        channels = next(model.parameters()).shape[1]
        answer = model(given.repeat(1, channels, 1, 1))
    answers = answer if isinstance(answer, list | tuple) else [answer]
    numbers = {f"answer {k}": mean_and_maximum(one) for k, one in enumerate(answers)}
    numbers |= {"loss": mean_and_maximum([losses[-1]["loss"]])}
    weights = (work / "model/weights.safetensors").read_bytes()
    return numbers, {"weights": hashlib.blake2b(weights, digest_size=16).hexdigest()}


def scores(recording: Path, out: Path) -> tuple[Numbers, dict[str, str]]:
    """`score.json` by the default command: each method's force, and its error."""
    run("bench", "score", recording, "-o", out)
    score = json.loads((out / "score.json").read_text())
    curve = score["curve"]
    numbers = {f"force, {name}": mean_and_maximum(force) for name, force in curve["predicted_mn"].items()}
    for name, method in score["methods"].items():
        numbers[f"error, {name}"] = mean_and_maximum(method["scores"]["mae_mn"])
    numbers["sensor"] = mean_and_maximum(curve["sensor_mn"])
    text = json.dumps({"curve": curve, "methods": score["methods"]}, sort_keys=True)
    return numbers, {"score": hashlib.blake2b(text.encode(), digest_size=16).hexdigest()}


def score_stored(work: Path, name: str, job: Sequence[str]) -> tuple[Numbers, dict[str, str]]:
    from bench.recording.from_sequence import export_recording
    from synth.dataset.store import open_sequence

    folder = work / f"recording-{name}"
    export_recording(open_sequence(render(work / name, job) / "000000.zarr"), folder)
    return scores(folder, work / f"score-{name}")


Case = Callable[[Path], tuple[Numbers, dict[str, str]]]
CASES: dict[str, Case] = {
    "default_sequence": lambda work: sequence(render(work / "default", ["sequences=1", "seed=0"])),
    "stereo_sequence": lambda work: sequence(render(work / "stereo", PAIR)),
    "epoch": epoch,
    "mono_recording": lambda work: score_stored(work, "mono", MONO),
    "stereo_recording": lambda work: score_stored(work, "stereo", PAIR),
    "moving_recording": lambda work: score_stored(work, "moving", MOVING),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--against", type=Path, help="a guard.json of another run")
    parser.add_argument("--case", choices=CASES, action="append", help="only these")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name in given.case or CASES:
        numbers, hashes = CASES[name](given.folder)
        found[name] = {"numbers": numbers, "hashes": hashes}
        print(name, flush=True)
    (given.folder / "guard.json").write_text(json.dumps(found, indent=1) + "\n")
    before = json.loads(given.against.read_text()) if given.against else {}
    for name in found.keys() & before.keys():
        for kind in ("numbers", "hashes"):
            was, now = before[name].get(kind, {}), found[name][kind]
            for key in sorted(was.keys() | now.keys()):
                if was.get(key) != now.get(key):
                    print(f"{name}: {key}: {was.get(key)} -> {now.get(key)}")


if __name__ == "__main__":
    main()
