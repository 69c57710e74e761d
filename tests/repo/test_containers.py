"""The container recipes: built where the tool and its registry are, else held to what a build needs."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from sources import ROOT

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
    assert f"{{{{ {argument.rstrip('=')} }}}}" in APPTAINER
    assert {line.split()[0] for line in told["test"]} == set(PROJECT["project"]["scripts"])


def test_both_install_the_same_way() -> None:
    install = re.search(r"pip install .*?'\.\[\w+\]'", DOCKER)
    assert install
    assert install[0] in APPTAINER
    assert "libllvm19" in DOCKER
    assert "libllvm19" in APPTAINER
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
