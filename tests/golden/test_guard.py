"""The whole pipeline gives the numbers that it gave, on every processor.

Within tolerances that arithmetic explains: adding in another order moves a rendered picture by parts in a
million, recovered flow by parts in ten thousand, and physics, which chooses between tissues, by parts in a
hundred. Bytes are compared only between runs on one machine (`tests/synth/sequence`, `tests/slow`).
"""

import json
from pathlib import Path

import pytest
from guard import CASES

EXPECTED = json.loads(Path(__file__).with_name("guard.json").read_text("utf-8"))
RECOVERED = ("flow_confidence", "flow_recovered", "motion_deviation", "motion_recovered")


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("guard")


def tolerance(case: str, name: str) -> float:
    if case.endswith("recording"):
        return 0.03
    return 0.01 if name in RECOVERED or case == "epoch" else 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param(one, marks=[pytest.mark.trial] * one.endswith("recording")) for one in CASES]
)
def test_numbers_are_those_of_before(case: str, work: Path) -> None:
    found, _ = CASES[case](work)
    expected = EXPECTED[case]["numbers"]
    assert found.keys() == expected.keys()
    off = {
        name: (found[name], value)
        for name, value in expected.items()
        if found[name] != pytest.approx(value, rel=tolerance(case, name), abs=1e-9)
    }
    assert not off
