"""What building the pages needs beside MkDocs: equations as MathML, and the results as they are found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from pathspec.gitignore import GitIgnoreSpec


def on_config(config: Any) -> Any:
    """Called by MkDocs with its settings, before it looks for files."""
    # Fences named `math`, which GitHub shows as well, need no script when they are MathML.
    fences = {"custom_fences": [{"name": "math", "class": "math", "format": _mathml}]}
    config.mdx_configs.setdefault("pymdownx.superfences", {}).update(fences)
    # Measuring commands write README.md and a chart as index.html: here both would be the folder's page.
    docs = Path(config.docs_dir)
    twice = [f"/{page.parent.relative_to(docs).as_posix()}/index.html" for page in docs.rglob("README.md")]
    config.exclude_docs = GitIgnoreSpec.from_lines(["*.py", *twice])
    rooms = sorted((docs / "results").glob("*/README.md"))
    listed = [{page.parent.name: page.relative_to(docs).as_posix()} for page in rooms]
    config.nav.append({"Results": ["results/README.md", *listed]})
    return config


def _mathml(source: str, *_: Any, **__: Any) -> str:
    """One displayed equation."""
    return f'<p class="equation">{convert(source.strip(), display="block")}</p>'
