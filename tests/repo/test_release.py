"""What stands in more than one file of the project's frame says the same in each."""

from __future__ import annotations

import re
import tomllib

from ruamel.yaml import YAML
from sources import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def yaml(name: str) -> dict[str, object]:
    content: dict[str, object] = YAML(typ="safe").load((ROOT / name).read_text("utf-8"))
    return content


def wanted(lines: list[str]) -> set[str]:
    """Names of packages in requirements, as an index spells them."""
    return {
        re.split(r"[^\w.-]", line)[0].lower().replace("_", "-") for line in lines if not line.startswith("#")
    }


def test_every_dependency_is_pinned() -> None:
    asked = wanted(PROJECT["dependencies"]).union(*map(wanted, PROJECT["optional-dependencies"].values()))
    pinned = wanted((ROOT / "constraints.txt").read_text("utf-8").splitlines())
    assert not asked - pinned
    assert {"mitsuba", "scikit-learn", "zensical"} <= asked


def test_version_and_licence_are_said_once() -> None:
    citation = yaml("CITATION.cff")
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])
    assert f"`{PROJECT['version']}`" in (ROOT / "CHANGELOG.md").read_text("utf-8")
