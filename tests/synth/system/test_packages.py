"""What compiles the loops is among what made a sequence."""

from __future__ import annotations

from importlib import metadata

from synth.dataset import provenance


def test_the_compiler_of_the_loops_is_named() -> None:
    made_by = provenance.generator()
    for name in ("numpy", "numba", "llvmlite"):
        assert made_by[name] == metadata.version(name)
