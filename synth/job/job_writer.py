"""Writing a job: a fully commented file from the schema, its JSON schema, and the job of a dataset."""

from __future__ import annotations

import io
import json
import textwrap
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from ruamel.yaml import YAML

from synth.job.schema import Job
from synth.system.config_file import section_of

_WIDTH = 100
_HEAD = """\
# A job: all settings of a dataset. Every key may be left out; these are the defaults.
# Render it:            synth render THIS_FILE -o OUT
# Override keys:         synth render THIS_FILE -o OUT render.spp=8 sequences=100
# Help in editors:      synth schema > job.schema.json
# yaml-language-server: $schema=job.schema.json

"""


def document_job(job: Job | None = None) -> str:
    """A job file with every key, its meaning, its range and its value; reading it returns the same job."""
    return _HEAD + "\n".join(section_lines(job or Job())).rstrip() + "\n"


def schema() -> dict[str, Any]:
    """JSON schema of a job file, for editors."""
    return Job.model_json_schema() | {"$schema": "https://json-schema.org/draft/2020-12/schema"}


def dump_job(job: Job) -> str:
    """The job as a plain YAML file, as stored in a dataset."""
    out = io.StringIO()
    writer = YAML(typ="safe")
    writer.default_flow_style = None
    writer.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    writer.dump(job.model_dump(mode="json"), out)
    return out.getvalue()


def section_lines(section: BaseModel, indent: str = "") -> list[str]:
    """Every key of a section with its meaning, its range and its value, as lines of YAML."""
    lines: list[str] = []
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        inner = section_of(field.annotation)
        text = field.description or (inner.__doc__ if inner else "") or ""
        allowed = "" if inner else limits(type(section), name)
        if inner is not None and value is None:
            allowed = f"Its keys: {', '.join(inner.model_fields)}."
        comment = " ".join([*text.split(), allowed]).strip()
        if inner is not None and lines and lines[-1]:
            lines.append("")
        lines += textwrap.wrap(comment, _WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
        if isinstance(value, BaseModel):
            lines += [f"{indent}{name}:", *section_lines(value, indent + "  ")]
        else:
            lines.append(f"{indent}{name}: {scalar(value)}".rstrip())
    return lines


def limits(model: type[BaseModel], key: str) -> str:
    """The values that a key allows: "(> 0)", "(linear | stable)"; empty if there is no limit."""
    spec = model.model_json_schema()["properties"][key]
    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    if "anyOf" in spec:  # an optional key: only its choices are listed
        spec, signs = spec["anyOf"][0], {}
    spec = spec.get("propertyNames", spec)
    spec = (spec.get("prefixItems") or [spec.get("items", spec)])[0]
    spec = spec.get("anyOf", [spec])[0]
    if "enum" in spec:
        return f"({' | '.join(map(str, spec['enum']))})"
    bounds = [(sign, spec[name]) for name, sign in signs.items() if name in spec]
    text = ", ".join(f"{sign} {bound:.12g}" for sign, bound in bounds if abs(bound) < 1e9)
    return text and f"({text})"


def scalar(value: Any) -> str:
    """A value as YAML in one line; empty for None."""
    if isinstance(value, Path) or (isinstance(value, str) and not value.replace("-", "_").isidentifier()):
        return json.dumps(str(value), ensure_ascii=False)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        return (
            f"{{{', '.join(f'{name}: {scalar(item)}' for name, item in fields.items() if item is not None)}}}"
        )
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name}: {scalar(item)}' for name, item in value.items())}}}"
    if isinstance(value, tuple):
        return f"[{', '.join(scalar(item) for item in value)}]"
    return "" if value is None else str(value)
