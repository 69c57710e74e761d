"""Rules that keep a dataset a function of its job, checked on the source itself; ruff bans clocks."""

import ast

from sources import PACKAGES, ROOT, imports, parse, sources


def test_no_global_generator_and_none_without_a_seed_in_synth() -> None:
    for path in sources("synth"):
        assert "random" not in imports(path), path
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Attribute):  # of NumPy's, ruff's NPY002 finds them
                assert ast.unparse(node) not in ("torch.rand", "torch.randn", "torch.manual_seed"), path
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng"):
                assert node.args, f"{path}:{node.lineno}: default_rng() takes its seed from the machine"


def test_no_path_of_a_machine_anywhere() -> None:
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    for path in [*sources(*PACKAGES, "tests", "examples", "docs"), *pages]:
        text = path.read_text("utf-8")
        for marker in ("/home" + "/", "/root" + "/", "/work" + "/", "/Users" + "/"):
            assert marker not in text, f"{path} names {marker}"
