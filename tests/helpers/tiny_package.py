"""A package as pip leaves it, in a folder on the path: a module, and metadata with its entry points."""

from collections.abc import Mapping
from pathlib import Path

import pytest


def install(
    folder: Path,
    module: str,
    code: str,
    points: Mapping[str, Mapping[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    version: str = "1.2",
) -> Path:
    """Installs `module` with entry points by group and name; gone from the path when the test ends."""
    info = folder / f"{module}-{version}.dist-info"
    info.mkdir(parents=True)
    (folder / f"{module}.py").write_text(code, "utf-8")
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: {version}\n")
    lines = [
        line
        for group, named in points.items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in named.items()), "")
    ]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(str(folder))
    return folder
