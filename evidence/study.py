"""Studies: one experiment a module, from its question to its page in docs/results.

A module of `evidence` with a constant `STUDY` is one. `python -m evidence MODULE` runs it, `all` and `status`
find it.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import typer

from evidence import report, result_status
from learn.training.threads import set_threads

STEREO_MOTION = "mesh", "mechanics", "picture", "truth", "flow", "stereo"
"""Probes that motion depends on which two cameras recover in renders."""

_HOME = Path(__file__).parent
_DEFINED = re.compile(r"^STUDY = ", re.M)


@dataclass(frozen=True)
class Study:
    """One experiment: what it measures, where its data are stored, and the page drawn from them."""

    measure: Callable[..., Mapping[str, Any] | None]
    """Takes the command's arguments and options; returns the data, None if it writes files of its own."""
    result: str = ""
    """JSON file under docs/results, or a pattern, if other programs write several into the folder of the
    option `results`; empty: no results."""
    page: Callable[[Mapping[str, Any]], report.Page] | None = None
    """Draws the data; None: other programs draw them."""
    steps: tuple[str, ...] = ("",)
    """Arguments of each run by `all`: by default one run without any. {NAME} stands for a dataset, an option
    of `all` (without it the step is left out), or `work`, the folder of intermediate results."""
    needs: tuple[str, ...] = ()
    """Probes of `evidence.guard` whose change would move its figures: those of the product's packages that it
    uses, also through data that it renders."""
    timed: bool = False
    """Whether it holds times: these are of a date and a machine."""


def names() -> list[str]:
    """Names of all studies: their modules, without `evidence`."""
    files = [file for file in _HOME.rglob("*.py") if _DEFINED.search(file.read_text("utf-8"))]
    return sorted(".".join(file.relative_to(_HOME).with_suffix("").parts) for file in files)


def load(name: str) -> Study:
    """The study of a module."""
    study: Study = import_module(f"evidence.{name}").STUDY
    return study


def command(name: str) -> Any:
    """Click's command of a study: its arguments and options, and `--out` if it has a page."""
    study = load(name)
    signature = inspect.signature(study.measure, eval_str=True)
    parameters, result = [*signature.parameters.values()], report.RESULTS / study.result
    if study.page is not None:
        out = inspect.Parameter("out", inspect.Parameter.KEYWORD_ONLY, default=result.parent, annotation=Path)
        parameters.append(out)

    @wraps(study.measure)
    def run(**options: Any) -> None:
        set_threads(1)
        cv2.setNumThreads(1)
        if study.page is None:
            study.measure(**options)
            if folder := options.get("results"):
                files = folder.glob(study.result[study.result.index("*") :])
                result_status.stamp_files(files, study.needs, study.timed)
                result_status.write_states(folder)
            return
        folder = options.pop("out")
        data = dict(study.measure(**options) or {}) | result_status.stamp(study.needs, study.timed)
        report.save(folder, result.name, data, study.page)
        result_status.write_states(folder)

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    app = typer.Typer(add_completion=False)
    app.command(name)(run)
    return typer.main.get_command(app)
