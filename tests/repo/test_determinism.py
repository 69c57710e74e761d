"""Rules that keep a dataset a function of its job, checked on the source itself."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from sources import PACKAGES, ROOT, imports, sources

# Progress, patience with processes and timings are not content; the stopwatch is the clock for the last.
MAY_READ_CLOCKS = {
    "synth/system/stopwatch.py",
    "synth/engine/progress.py",
    "synth/engine/child.py",
    "synth/engine/journal.py",
    "synth/dataset/folder.py",
    # Of somebody's film: no dataset holds what these make.
    "synth/recording_flow/local_flow.py",
    "synth/recording_flow/video_flow.py",
}
CLOCKS = {"time", "datetime", "uuid", "secrets"}
RANDOM_CLASSES = {"Generator", "SeedSequence", "default_rng", "PCG64", "BitGenerator"}


def attributes(text: str) -> Iterator[str]:
    """Dotted names used in the source: `np.random.rand`."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute):
            yield ast.unparse(node)


def global_random(text: str) -> list[str]:
    """Uses of a generator that nobody passed in."""
    bad = []
    for name in attributes(text):
        head, _, tail = name.rpartition(".")
        if head in ("np.random", "numpy.random") and tail not in RANDOM_CLASSES:
            bad.append(name)
        if head == "random" or name in ("torch.rand", "torch.randn", "torch.manual_seed"):
            bad.append(name)
    return bad


def test_no_clock_no_uuid_in_synth() -> None:
    for path in sources("synth"):
        if str(path.relative_to(ROOT)) not in MAY_READ_CLOCKS:
            used = {name.split(".")[0] for name in imports(path)} & CLOCKS
            assert not used, f"{path} imports {used}: what it makes would depend on when it runs"


def test_no_global_generator_in_synth() -> None:
    for path in sources("synth"):
        assert not global_random(path.read_text("utf-8")), path
        assert "random" not in set(imports(path)), path


def test_no_generator_without_a_seed_in_synth() -> None:
    for path in sources("synth"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng"):
                assert node.args, f"{path}:{node.lineno}: default_rng() takes its seed from the machine"


def test_no_path_of_a_machine_anywhere() -> None:
    for path in [
        *sources(*PACKAGES, "tests", "examples", "docs"),
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
    ]:
        text = path.read_text("utf-8")
        for marker in ("/home" + "/", "/root" + "/", "/work" + "/", "/Users" + "/"):
            assert marker not in text, f"{path} names {marker}"
