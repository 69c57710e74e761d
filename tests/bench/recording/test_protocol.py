"""The protocol of a first recording, and which of it a recording has."""

from pathlib import Path
from typing import Any

import numpy as np
from command import run

from bench.checks import protocol
from bench.checks.protocol import check_protocol, read_steps
from bench.cli import app
from bench.recording.meta import Meta
from bench.recording.recording_folder import Force, Recording


def find_lacking(tissue: Path | None = None, sensor_file: bool = True, **statements: Any) -> set[str]:
    """Steps that a recording lacks with these statements."""
    meta = Meta.model_validate({"scale_mm_per_px": "unknown", **statements})
    time_s = np.arange(40) / 200  # three taps
    force = Force(time_s, np.outer(np.sin(15 * np.pi * time_s) ** 8, [1.0, 0, 0])) if sensor_file else None
    recording = Recording(Path(), meta, {}, None, force, None, tissue, ())  # type: ignore[arg-type]
    findings = check_protocol(recording)
    return {finding.message.split(":")[0] for finding in findings if finding.severity == "missing"}


def test_each_statement_ticks_its_step(tmp_path: Path) -> None:
    assert set(protocol._IS_IN) < {step["title"] for step in read_steps()}
    statements: dict[str, dict[str, Any]] = {
        "scale": {"scale_mm_per_px": 0.1},
        "stiffness": {"young_kpa": 1.0},
        "membrane": {"membrane": "intact"},
        "membrane's stiffness": {"membrane_mn_per_mm": [20, 60]},
        "press": {"press_s": [0.1, 0.2]},
        "rest": {"pulse": {"free_s": [[0, 0.1]]}},
        "sensor": {"sensor": {"axes": "camera"}},
        "taps": {"sync": {"method": "correlate", "calibration_s": [0, 0.2]}},
        "outline": {"tissue": Path("tissue.png")},
    }
    assert find_lacking() == {*protocol._IS_IN}
    for title, meta in statements.items():
        assert find_lacking(**meta) == {*protocol._IS_IN} - {title}
    assert find_lacking(membrane="stripped") == {*protocol._IS_IN} - {"membrane", "membrane's stiffness"}
    assert find_lacking(sensor_file=False, **statements["sensor"], **statements["taps"]) == {*protocol._IS_IN}
    one_tap = {"sync": {"method": "correlate", "calibration_s": [0, 0.05], "search_s": 0.01}}
    assert "taps" in find_lacking(**one_tap), "a request to correlate is no tap"
    run(app, "init", "--protocol", tmp_path / "new")
    page = tmp_path / "new/protocol.md"
    assert page.read_text().count("- [ ] ") == len(read_steps())
    run(app, "init", "--protocol", tmp_path / "new", code=2)  # ticks are not overwritten
    page.unlink()
    run(app, "init", "--protocol", tmp_path / "new")
    assert page.exists()
