"""The GPU run's own mechanics: every step is accounted for, whatever the others do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evidence.gpu import run_steps


@pytest.mark.slow
def test_a_step_that_fails_or_hangs_does_not_stop_the_next(tmp_path: Path) -> None:
    steps = (
        ("fails", ("-c", "raise SystemExit(3)")),
        ("hangs", ("-c", "import time; time.sleep(60)")),
        ("says", ("-c", "print('seen')")),
    )
    found = run_steps(steps, tmp_path, limit_s=2.0)
    assert [outcome.exit_code for outcome in found] == [3, -1, 0]
    assert (tmp_path / "says.log").read_text() == "seen\n"
    assert [step["name"] for step in json.loads((tmp_path / "gpu.json").read_text())["steps"]] == [
        "fails",
        "hangs",
        "says",
    ]
