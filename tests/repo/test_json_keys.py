"""What `--json` gives: no key of the record goes missing; new ones may come.

`json_keys.json` is of the commit before the rooms; a command that is new there gets its keys by

    PYTHONPATH=.:tests/helpers python tests/repo/test_json_keys.py FOLDER
"""

from __future__ import annotations

import json
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import fake_work
import numpy as np
import phantom
import pytest
from egg_brain import soup, written
from fake_recording import Maker, texture
from fake_run import in_process
from typer.testing import CliRunner

from synth.job.schema import Job

# Lightning's, on machines that have Slurm.
pytestmark = pytest.mark.filterwarnings("ignore:The .srun. command is available")

RECORD = Path(__file__).with_name("json_keys.json")
QUICK = (
    "synth status {out}",
    "synth verify {out}",
    "synth verify {out} --fast",
    "synth split {out}",
    "synth fields",
    "synth doctor {folder}",
    "synth place {folder}/egg.stl --radius 8 --count 2 --out {folder}/openings",
    "learn eval {model} {data}",
    "learn eval {model} {data} --against {model}",
    "learn predict {model} {data} --out {folder}/forces",
    "learn calibrate {model} {data}/000000.zarr",
    "bench check {recording}",
    "bench from-dataset {data} --out {folder}/recordings --sequence 1",
    "bench flow {folder}/rest.png {folder}/moved.png {folder}/truth.flo --flow dis",
)
SLOW = (
    "learn train {data} size=32 arch.width=8 --preset tiny --epochs 1 --out {folder}/trained",
    "synth render tiny --out {folder}/rendered sequences=2 render.spp=1 anatomy.vertices=2500 fem.tets=400",
    "synth retry {folder}/rendered",
    "bench score {recording} --model {model} --flow dis --out {folder}/score",
    "bench pool {folder}/score --out {folder}/pooled",
    "bench demo {data} --model {model} --flow dis --out {folder}/demo",
    "bench live {film}/video.mp4 --every --flow dis",
    "bench stability damage {out} --count 10 --out {folder}/damage",
    "bench pareto reading {out} --count 2 --out {folder}/reading",
    "bench pareto all --out {folder}/pareto",
    "bench stability all --out {folder}/stability",
)

FIRST = {"synth retry {folder}/rendered": SLOW[1], "bench pool {folder}/score --out {folder}/pooled": SLOW[3]}
"""What has to be there before, whichever tests ran in this process."""


def build(folder: Path) -> dict[str, Path]:
    """What the commands are asked about: datasets, recordings, pictures and a model."""
    job = Job(seed=1, sequences=3, frames=5, render={"size": (96, 72)}, flow={"backend": "ideal"})
    in_process(job, folder / "out", fake_work.consistent)
    (folder / "data").mkdir()
    for index in range(4):
        phantom.write(folder / "data", index, anatomy_seed=index)
    written(folder / "egg.stl", soup())
    make = Maker(folder)
    places = {"folder": folder, "out": folder / "out", "data": folder / "data", "model": folder / "model"}
    places |= {"recording": make(frames=12), "film": make("film", frames=6, footage="mp4")}
    for name, by in (("rest", 0), ("moved", 1)):
        cv2.imwrite(str(folder / f"{name}.png"), np.roll(texture(64, 64), by, axis=1))
    cv2.writeOpticalFlow(str(folder / "truth.flo"), np.full((64, 64, 2), (1, 0), np.float32))
    trained = ["train", str(places["data"]), "size=32", "arch.width=8", "--preset", "tiny", "--epochs", "1"]
    done = CliRunner().invoke(import_module("learn.cli").app, [*trained, "--out", str(places["model"])])
    assert done.exit_code == 0, done.output
    return places


def ask(line: str, places: dict[str, Path]) -> Any:
    """The keys of what the command prints."""
    if line in FIRST:
        ask(FIRST[line], places)
    program, *words = line.split()
    given = [word.format(**places) for word in words]
    done = CliRunner().invoke(import_module(f"{program}.cli").app, [*given, "--json"])
    assert done.exit_code in (0, 1), f"{line}: {done.output} {done.exception!r}"
    return keys(json.loads(done.stdout.strip().splitlines()[-1]))


def keys(tree: Any) -> dict[str, Any]:
    """A tree's keys as a tree; what the elements of a list have in common or alone stands under `[]`."""
    if isinstance(tree, dict):
        return {name: keys(value) for name, value in tree.items()}
    merged: dict[str, Any] = {}
    for value in tree if isinstance(tree, list) else ():
        merged = _merged(merged, keys(value))
    return {"[]": merged} if merged else {}


def _merged(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    return {name: _merged(one.get(name, {}), other.get(name, {})) for name in [*one, *other]}


def missing(kept: dict[str, Any], now: dict[str, Any], at: str = "") -> list[str]:
    """Keys of the first that the second has not."""
    gone = [f"{at}{name}" for name in kept if name not in now]
    return gone + [
        path for name in kept if name in now for path in missing(kept[name], now[name], f"{at}{name}.")
    ]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return build(tmp_path_factory.mktemp("json"))


@pytest.mark.slow
@pytest.mark.parametrize("line", [*QUICK, *(pytest.param(line, marks=pytest.mark.slow) for line in SLOW)])
def test_no_key_went_missing(line: str, places: dict[str, Path]) -> None:
    kept = json.loads(RECORD.read_text("utf-8"))[line]
    assert kept, "an empty record guards nothing"
    assert missing(kept, ask(line, places)) == []


def test_the_record_has_these_commands_and_no_others() -> None:
    assert list(json.loads(RECORD.read_text("utf-8"))) == [*QUICK, *SLOW]


def test_a_key_that_is_gone_is_named() -> None:
    kept = keys({"a": [{"b": 1}, {"c": {"d": 2}}], "e": []})
    assert kept == {"a": {"[]": {"b": {}, "c": {"d": {}}}}, "e": {}}
    assert missing(kept, keys({"a": [{"b": 1, "c": {}}], "e": [], "f": 0})) == ["a.[].c.d"]
    assert missing(kept, kept) == []


if __name__ == "__main__":
    made = build(Path(tempfile.mkdtemp(dir=sys.argv[1])))
    rows = (f"{json.dumps(line)}: {json.dumps(ask(line, made))}" for line in (*QUICK, *SLOW))
    print("{\n" + ",\n".join(rows) + "\n}")
