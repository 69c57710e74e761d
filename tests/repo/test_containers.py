"""The container recipes: built where the tool and its registry are, else held to what a build needs."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet
from packaging.version import Version
from sources import ROOT

from synth.system import llvm_setup

DOCKER = (ROOT / "Dockerfile").read_text("utf-8")
APPTAINER = (ROOT / "apptainer.def").read_text("utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def instructions() -> list[tuple[str, str]]:
    """Keyword and rest of every instruction of the Dockerfile, continued lines joined."""
    text = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", DOCKER, flags=re.MULTILINE))
    return [
        (word, rest.strip()) for word, _, rest in (line.partition(" ") for line in text.splitlines()) if word
    ]


def sections() -> dict[str, list[str]]:
    """The definition's header ("") and sections by name, without comments."""
    found: dict[str, list[str]] = {"": []}
    here = ""
    for line in APPTAINER.splitlines():
        if line.startswith("%"):
            here = line[1:].strip()
            found[here] = []
        elif line.strip() and not line.startswith("#"):
            found[here].append(line.strip())
    return found


def packages(text: str) -> set[str]:
    """What is installed of Debian's."""
    found = re.search(r"apt-get install -y --no-install-recommends ([\w ]+)", text)
    return set(found[1].split()) if found else set()


_PROVIDED = {
    **dict.fromkeys((f"lib{name}.so.6" for name in ("c", "m", "stdc++")), "the image"),
    **dict.fromkeys(
        ("libpthread.so.0", "libdl.so.2", "librt.so.1", "libgcc_s.so.1", "libz.so.1"), "the image"
    ),
    "libatomic.so.1": "libatomic1",
}


def needed() -> set[str]:
    """What a build of the wheel reads."""
    project = PROJECT["project"]
    packages = {name.rstrip("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]}
    return {"pyproject.toml", "constraints.txt", project["readme"], *project["license-files"], *packages}


def test_the_dockerfile_has_what_a_build_needs() -> None:
    told = instructions()
    words = [word for word, _ in told]
    assert words[0] == "FROM"
    assert set(words) <= {"FROM", "RUN", "ARG", "WORKDIR", "COPY", "USER", "CMD"}
    copied = {name for word, rest in told if word == "COPY" for name in rest.split()[:-1]}
    assert copied == needed()
    assert all((ROOT / name).exists() for name in copied)
    assert words.index("USER") < words.index("CMD"), "it does not run as root"
    for _, rest in (one for one in told if one[0] == "RUN"):
        if "apt-get install" in rest:
            assert "apt-get update" in rest
            assert "rm -rf /var/lib/apt/lists" in rest


def test_the_image_has_the_python_that_the_constraints_are_of() -> None:
    image = re.search(r"^FROM python:(\d+\.\d+)-", DOCKER, re.MULTILINE)
    assert image
    assert f"on Python {image[1]}" in (ROOT / "constraints.txt").read_text("utf-8").splitlines()[0]
    assert Version(image[1]) in SpecifierSet(PROJECT["project"]["requires-python"])


def test_what_the_renderer_is_linked_against_is_installed() -> None:
    """By the loader's own word: neither wheel brings all that it needs."""
    specs = [find_spec(name) for name in ("drjit", "mitsuba")]
    homes = [Path(spec.origin).parent for spec in specs if spec is not None and spec.origin is not None]
    files = [path for home in homes for path in home.glob("*.so*")]
    told = subprocess.run(["ldd", *map(str, files)], capture_output=True, text=True).stdout
    needed = {line.split()[0] for line in told.splitlines() if "=>" in line} - {path.name for path in files}
    assert "libatomic.so.1" in needed
    assert {_PROVIDED[name] for name in needed} <= packages(DOCKER) | {"the image"}


def test_commands_in_comments_are_ours() -> None:
    known = json.loads(Path(__file__).with_name("commands.json").read_text("utf-8"))
    for text in (DOCKER, APPTAINER):
        (told,) = re.findall(r"^# .* ((?:synth|learn|bench) \S+) .*$", text, re.MULTILINE)
        assert told in known
    run = next(rest for word, rest in instructions() if word == "CMD")
    assert json.loads(run)[0] in PROJECT["project"]["scripts"]


def test_what_docker_sends_is_what_is_copied() -> None:
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text("utf-8").splitlines() if line[:1] == "!"}
    assert kept == needed()


def test_the_apptainer_definition_has_what_a_build_needs() -> None:
    told = sections()
    assert list(told) == ["", "arguments", "files", "post", "runscript", "test"]
    header = dict(line.split(": ", 1) for line in told[""])
    assert header["Bootstrap"] == "docker"
    assert ("FROM", header["From"]) in instructions(), "both start from one image"
    assert {line.split()[0] for line in told["files"]} == needed()
    assert all(line.split()[1] == f"/opt/sulcus/{line.split()[0]}" for line in told["files"])
    (argument,) = told["arguments"]
    name, _, default = argument.partition("=")
    assert f"{{{{ {name} }}}}" in APPTAINER
    assert default, "Apptainer takes an empty default for none and stops at the name"
    assert {line.split()[0] for line in told["test"]} == set(PROJECT["project"]["scripts"])


def test_both_install_the_same_way() -> None:
    install = re.search(r"pip install .*?'\.\[\w+\]'", DOCKER)
    assert install
    assert install[0] in APPTAINER
    assert packages(DOCKER) == packages(APPTAINER)
    assert llvm_setup._PACKAGE in packages(DOCKER)
    extra = install[0].split("[")[1].split("]")[0]
    assert extra in PROJECT["project"]["optional-dependencies"]


@pytest.mark.slow
def test_docker_builds_it(tmp_path: Path) -> None:
    if shutil.which("docker") is None or subprocess.run(["docker", "info"], capture_output=True).returncode:
        pytest.skip("no Docker daemon to build with")
    mark = tmp_path / "id"
    build = ["docker", "build", "-q", "--iidfile", str(mark), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True)
    if "failed to resolve" in done.stderr or "failed to fetch" in done.stderr:
        pytest.skip("the base image is out of reach")
    assert done.returncode == 0, done.stderr
    image = mark.read_text()
    try:
        shown = subprocess.run(["docker", "run", "--rm", image], capture_output=True, text=True)
        assert "synth" in shown.stdout
    finally:
        subprocess.run(["docker", "rmi", image], capture_output=True, check=False)


@pytest.mark.slow
def test_apptainer_builds_it(tmp_path: Path) -> None:
    tool = shutil.which("apptainer") or shutil.which("singularity")
    if tool is None:
        pytest.skip("no Apptainer to build with")
    image = tmp_path / "sulcus.sif"
    done = subprocess.run(
        [tool, "build", str(image), "apptainer.def"], cwd=ROOT, capture_output=True, text=True
    )
    if "connection" in done.stderr.lower():
        pytest.skip("the base image is out of reach")
    assert done.returncode == 0, done.stderr
    assert subprocess.run([tool, "exec", str(image), "synth", "--help"]).returncode == 0
