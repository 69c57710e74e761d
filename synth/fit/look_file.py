"""The fitted family as a job file: its lines can be rendered as they are, or put into another job."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from synth.fit import parameters
from synth.fit.search import Fitted
from synth.job.schema import Job

_AROUND = 0.1  # of a fitted value: what sequences vary by


def sections(fitted: Fitted, chroma: str, bitrate_mbps: float | None) -> dict[str, Any]:
    """Sections of a job with what was found; strengths as ranges around it."""
    found = parameters.as_job(fitted.values, fitted.family)
    for name in ("arterial", "film_mm"):
        middle = fitted.values[name]
        found["appearance"]["own"][name] = [middle * (1 - _AROUND), middle * (1 + _AROUND)]
    glare = found["light"]["glare"][0]
    found["light"]["glare"] = [max(0.0, glare - 0.05), min(1.0, glare + 0.05)]
    found["sensor"] |= {"chroma": chroma}
    if bitrate_mbps is not None:
        found["sensor"]["bitrate_mbps"] = bitrate_mbps
    rounded: dict[str, Any] = _rounded(found)
    Job.model_validate(rounded)
    return rounded


def text(fitted: Fitted, found: dict[str, Any], heading: list[str]) -> str:
    """The YAML file."""
    out = io.StringIO()
    writer = YAML(typ="safe")
    writer.default_flow_style = None
    writer.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    writer.dump(found, out)
    lines = [*heading]
    if fitted.left:
        lines.append(f"Not to be seen in it, as the family {fitted.family} has them: {_named(fitted.left)}.")
    if fitted.bounded:
        lines.append(f"At a limit, look at the picture: {_named(fitted.bounded)}.")
    if fitted.undecided:
        lines.append(f"Not decided by this picture, one standard deviation: {undecided(fitted)}.")
    return "".join(f"# {line}\n" for line in lines) + out.getvalue()


def undecided(fitted: Fitted) -> str:
    """What the picture doesn't tell within 15%, each with its standard deviation, of a colour the largest."""
    widest: dict[str, float] = {}
    for name in fitted.undecided:
        short = name.split()[0]
        widest[short] = max(widest.get(short, 0.0), fitted.unsure[name])
    linear = {one.name for one in parameters.PARAMETERS if one.scale == "linear"}
    return ", ".join(
        f"{name} {sd:.2f}" if name in linear else f"{name} {100 * np.expm1(sd):.0f}%"
        for name, sd in widest.items()
    )


def _named(names: tuple[str, ...]) -> str:
    """Names, three channels as one colour."""
    return ", ".join(dict.fromkeys(name.split()[0] for name in names))


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_rounded(inner) for inner in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{float(value):.4g}")
    return value
