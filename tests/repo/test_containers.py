"""The container recipes: held to what a build needs, and built where the tool and its registry are."""

from __future__ import annotations

import re
import subprocess
import tomllib
from importlib.util import find_spec
from pathlib import Path

from sources import ROOT

DOCKER = (ROOT / "Dockerfile").read_text("utf-8")
APPTAINER = (ROOT / "apptainer.def").read_text("utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
DEBIAN = {
    **dict.fromkeys((f"lib{name}.so.6" for name in ("c", "m", "stdc++")), "the image"),
    **dict.fromkeys((f"lib{name}" for name in ("pthread.so.0", "dl.so.2", "rt.so.1")), "the image"),
    **dict.fromkeys(("libgcc_s.so.1", "libz.so.1"), "the image"),
    "libatomic.so.1": "libatomic1",
}


def packages(text: str) -> set[str]:
    """What is installed of Debian's."""
    found = re.search(r"apt-get install -y --no-install-recommends ([\w ]+)", text)
    return set(found[1].split()) if found else set()


def test_what_a_build_of_the_wheel_reads_is_sent_and_copied() -> None:
    project = PROJECT["project"]
    rooms = {name.rstrip("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]}
    needed = {"pyproject.toml", "constraints.txt", project["readme"], *project["license-files"], *rooms}
    joined = re.sub(r"\\\n\s*", "", DOCKER)
    copied = {name for rest in re.findall(r"^COPY (.*)$", joined, re.MULTILINE) for name in rest.split()[:-1]}
    ignored = (ROOT / ".dockerignore").read_text("utf-8")
    assert copied == needed == {line[1:] for line in ignored.splitlines() if line[:1] == "!"}
    files = APPTAINER.partition("%files")[2].partition("%")[0]
    assert {line.split()[0] for line in files.splitlines() if line.strip()} == needed


def test_what_the_renderer_is_linked_against_is_installed() -> None:
    """By the loader's own word: neither wheel brings all that it needs."""
    specs = [find_spec(name) for name in ("drjit", "mitsuba")]
    homes = [Path(spec.origin).parent for spec in specs if spec is not None and spec.origin is not None]
    files = [path for home in homes for path in home.glob("*.so*")]
    told = subprocess.run(["ldd", *map(str, files)], capture_output=True, text=True).stdout
    needed = {line.split()[0] for line in told.splitlines() if "=>" in line} - {path.name for path in files}
    assert "libatomic.so.1" in needed
    for recipe in (DOCKER, APPTAINER):
        assert {DEBIAN[name] for name in needed} <= packages(recipe) | {"the image"}
