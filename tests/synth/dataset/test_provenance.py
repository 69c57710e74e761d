"""What made a sequence is named: code, networks and packages."""

from __future__ import annotations

from pathlib import Path

from sources import imports

from synth.dataset import provenance


def test_what_decides_values_is_counted(tmp_path: Path) -> None:
    for name in ("flow/tvl1.py", "flow/toolnet.pt", "fem/mesh/lattice.py", "engine/run.py", "flow/README.md"):
        file = tmp_path / "synth" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("x = 1\n")

    def now() -> str:
        return provenance.code("synth/flow", "synth/fem", home=tmp_path)

    before = now()
    for name, counts in (
        ("engine/run.py", False),
        ("flow/README.md", False),
        ("flow/tvl1.py", True),
        ("flow/toolnet.pt", True),
        ("fem/mesh/lattice.py", True),
    ):
        (tmp_path / "synth" / name).write_text("x = 2\n")
        assert (now() != before) == counts, name
        before = now()
    (tmp_path / "synth/flow/tvl1.py").rename(tmp_path / "synth/flow/tvl2.py")
    assert now() != before


def test_rooms_that_a_sequence_is_made_with_are_counted_or_decide_no_value() -> None:
    made = {
        "/".join(name.split(".")[:2])
        for room in provenance._MAKING
        for path in (provenance.HOME / room).rglob("*.py")
        for name in imports(path)
        if name.startswith("synth.")
    }
    deciding_none = {f"synth/{name}" for name in ("errors", "fields", "plugins", "system", "dataset")}
    assert made - deciding_none == set(provenance._MAKING)
