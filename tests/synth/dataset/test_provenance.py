"""The provenance of a sequence: versions and packages are compared, source is only recorded."""

from pathlib import Path

import pytest
from sources import imports

from synth import formats
from synth.dataset import provenance


def test_source_is_recorded_and_not_compared() -> None:
    generator = provenance.generator()
    assert provenance.word(generator | {"source": "other"}) == provenance.fingerprint()
    for name in ("format", "content", "motion", "numpy"):
        assert provenance.word(generator | {name: "other"}) != provenance.fingerprint(), name


def test_the_recorded_source_follows_code_and_networks(tmp_path: Path) -> None:
    files = dict.fromkeys(("engine/run.py", "flow/README.md"), False)
    files |= dict.fromkeys(("flow/tvl1.py", "flow/segmentation.onnx", "fem/mesh/lattice.py"), True)
    for name in files:
        file = tmp_path / "synth" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("x = 1\n")

    def hash_code() -> str:
        return provenance.code("synth/flow", "synth/fem", home=tmp_path)

    old_hash = hash_code()
    for name, is_hashed in files.items():
        (tmp_path / "synth" / name).write_text("x = 2\n")
        assert (hash_code() != old_hash) == is_hashed, name
        old_hash = hash_code()
    (tmp_path / "synth/flow/tvl1.py").rename(tmp_path / "synth/flow/tvl2.py")
    assert hash_code() != old_hash


def test_the_version_of_motion_follows_its_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old_version = formats.motion_version()
    monkeypatch.setattr(formats, "MOTION_WEIGHTS", tmp_path)
    (tmp_path / "a.onnx").write_bytes(b"one")
    assert formats.motion_version.__wrapped__() != old_version


def test_packages_that_a_sequence_is_made_with_are_recorded_or_have_no_effect_on_values() -> None:
    packages = {
        "/".join(name.split(".")[:2])
        for package in provenance._MAKING
        for path in (provenance.HOME / package).rglob("*.py")
        for name in imports(path)
        if name.startswith("synth.")
    }
    neutral_packages = ["arguments", "arrays", "errors", "fields", "formats", "plugins", "system", "dataset"]
    assert packages - {f"synth/{name}" for name in neutral_packages} == set(provenance._MAKING)
