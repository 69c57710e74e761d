"""Two processes on one machine, as torchrun starts them: the same weights in both, one model written."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from learn.inference.predict import load_model


@pytest.mark.trial
def test_two_processes_train_one_model(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "model"
    train = ["-m", "learn", "train", str(dataset), "-o", str(out), "--preset", "tiny", "size=32"]
    train += ["arch.width=8", "--epochs", "2", "--accelerator", "cpu", "--devices", "2", "--json"]
    train += ["arch.levels=2"]
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [sys.executable, *torchrun, *train],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert [json.loads(line)["epoch"] for line in (out / "history.jsonl").read_text().splitlines()] == [1, 2]
    assert load_model(out).card.epoch in (1, 2)
    # Only the first process prints its line of JSON.
    assert len([line for line in done.stdout.splitlines() if line.startswith("{")]) == 1
