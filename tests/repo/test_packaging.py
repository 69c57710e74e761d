"""The wheel, the container recipes and the pinned requirements hold what the package needs, and agree."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from sources import ROOT

from synth.system import llvm

DOCKER = (ROOT / "Dockerfile").read_text("utf-8")
APPTAINER = (ROOT / "apptainer.def").read_text("utf-8")
TOML = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PROJECT = TOML["project"]
PRODUCT = ("synth", "learn", "bench")
IN_IMAGE = {f"lib{name}" for name in ("c.so.6", "m.so.6", "stdc++.so.6", "pthread.so.0", "dl.so.2")}
IN_IMAGE |= {"librt.so.1", "libgcc_s.so.1", "libz.so.1"}
"""Libraries of the containers' base image."""


def names(requirements: list[str]) -> set[str]:
    """Names of packages in requirements, as an index spells them."""
    lines = (line for line in requirements if not line.startswith("#"))
    return {re.split(r"[^\w.-]", line)[0].lower().replace("_", "-") for line in lines}


def test_every_dependency_is_pinned() -> None:
    required = names(PROJECT["dependencies"]).union(*map(names, PROJECT["optional-dependencies"].values()))
    assert not required - names((ROOT / "constraints.txt").read_text("utf-8").splitlines())
    assert {"mitsuba", "scikit-learn", "zensical"} <= required


def test_files_agree_on_version_and_licence() -> None:
    citation = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])
    assert f"`{PROJECT['version']}`" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_containers_copy_what_a_build_of_the_wheel_reads() -> None:
    packages = {name.rstrip("*") for name in TOML["tool"]["setuptools"]["packages"]["find"]["include"]}
    inputs = {"pyproject.toml", "constraints.txt", PROJECT["readme"], *PROJECT["license-files"], *packages}
    dockerfile = re.sub(r"\\\n\s*", "", DOCKER)
    copies = {
        name for rest in re.findall(r"^COPY (.*)$", dockerfile, re.MULTILINE) for name in rest.split()[:-1]
    }
    ignore_lines = (ROOT / ".dockerignore").read_text("utf-8")
    assert copies == inputs == {line[1:] for line in ignore_lines.splitlines() if line[:1] == "!"}
    files = APPTAINER.partition("%files")[2].partition("%")[0]
    assert {line.split()[0] for line in files.splitlines() if line.strip()} == inputs


def test_containers_install_what_the_renderer_is_linked_against() -> None:
    """According to `ldd`: the wheels of Mitsuba and drjit lack some of their libraries."""
    specs = [find_spec(name) for name in ("drjit", "mitsuba")]
    homes = [Path(spec.origin).parent for spec in specs if spec is not None and spec.origin is not None]
    files = [path for home in homes for path in home.glob("*.so*")]
    listing = subprocess.run(["ldd", *map(str, files)], capture_output=True, text=True).stdout
    libraries = {line.split()[0] for line in listing.splitlines() if "=>" in line} - {
        path.name for path in files
    }
    assert libraries - IN_IMAGE == {"libatomic.so.1"}
    for library in llvm.find_packaged():  # it brings what is next to it
        listing = subprocess.run(["ldd", library], capture_output=True, text=True).stdout
        pairs = (line.split()[::2] for line in listing.splitlines() if "=>" in line)
        folder = Path(library).parent
        foreign = {name for name, path in pairs if folder not in Path(os.path.normpath(path)).parents}
        assert foreign <= IN_IMAGE | {"libatomic.so.1"}
    assert all(re.search(r"apt-get install .*\blibatomic1\b", recipe) for recipe in (DOCKER, APPTAINER))


@pytest.mark.trial
def test_the_wheel_holds_the_product_and_its_commands_run(tmp_path: Path) -> None:
    source, wheels, content = (tmp_path / name for name in ("source", "made", "content"))
    for name in PRODUCT:  # a copy, as a build leaves folders behind
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "--disable-pip-version-check", "--no-deps"]
    build = [*pip, "--no-build-isolation", "-q", "-w", str(wheels), "."]
    subprocess.run(build, cwd=source, check=True)
    (wheel,) = wheels.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(content)

    packed_files = {path.relative_to(content).as_posix() for path in content.rglob("*") if path.is_file()}
    ours = {
        path.relative_to(ROOT).as_posix()
        for name in PRODUCT
        for path in (ROOT / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".nbi", ".nbc")
    }
    assert {name for name in packed_files if ".dist-info/" not in name} == ours

    environment = {**os.environ, "PYTHONPATH": str(content)}
    script = "import synth.job.reader as r; r.load_job('demo', []); print(r.__file__)"
    helps = (["-m", program, "--help"] for program in PRODUCT)
    for words in (*helps, ["-m", "synth", "new", "job.yaml"], ["-c", script]):
        result = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(str(content)), "the checkout was imported, not the wheel"
    assert (tmp_path / "job.yaml").is_file()
