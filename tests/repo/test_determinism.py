"""Rules that keep a dataset a function of its job, checked on the source itself."""

import ast

from sources import PACKAGES, ROOT, imports, parsed, sources

# For progress, time limits and timings, which are not content; the stopwatch is the clock of the timings.
MAY_READ_CLOCKS = {
    "synth/system/stopwatch.py",
    "synth/engine/child.py",
    "synth/engine/journal.py",
    "synth/system/file_lock.py",
    # Flow of a user's recording: not part of any dataset.
    "synth/recording_flow/flow.py",
    "synth/recording_flow/passes.py",
}
CLOCKS = {"time", "datetime", "uuid", "secrets"}
RANDOM_CLASSES = {"Generator", "SeedSequence", "default_rng", "PCG64", "BitGenerator"}


def draws_from_global_generator(node: ast.Attribute) -> bool:
    """Whether a dotted name such as `np.random.rand` is of a generator that was not passed in."""
    name = ast.unparse(node)
    head, _, tail = name.rpartition(".")
    if head in ("np.random", "numpy.random") and tail not in RANDOM_CLASSES:
        return True
    return head == "random" or name in ("torch.rand", "torch.randn", "torch.manual_seed")


def test_no_clock_no_uuid_in_synth() -> None:
    for path in sources("synth"):
        if str(path.relative_to(ROOT)) not in MAY_READ_CLOCKS:
            used = {name.split(".")[0] for name in imports(path)} & CLOCKS
            assert not used, f"{path} imports {used}: what it writes would depend on when it runs"


def test_no_global_generator_and_none_without_a_seed_in_synth() -> None:
    for path in sources("synth"):
        assert "random" not in imports(path), path
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Attribute):
                assert not draws_from_global_generator(node), f"{path}:{node.lineno}"
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng"):
                assert node.args, f"{path}:{node.lineno}: default_rng() takes its seed from the machine"


def test_no_path_of_a_machine_anywhere() -> None:
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    for path in [*sources(*PACKAGES, "tests", "examples", "docs"), *pages]:
        text = path.read_text("utf-8")
        for marker in ("/home" + "/", "/root" + "/", "/work" + "/", "/Users" + "/"):
            assert marker not in text, f"{path} names {marker}"
