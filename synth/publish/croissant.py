"""Machine-readable description of a dataset: Croissant 1.1 (mlcommons.org/croissant) and Responsible AI."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pyarrow as pa

from synth.dataset import index
from synth.dataset.folder import Folder, write_whole
from synth.fields import FIELDS
from synth.publish import card

NAME = "croissant.json"
_BASE = Path(__file__).parent / "croissant_base.json"
"""What is the same of every dataset, with the specification's context and the prefix rai."""

_TYPES = {pa.int64(): "sc:Integer", pa.float64(): "sc:Float", pa.string(): "sc:Text"}


def write_croissant(folder: Folder) -> Path:
    """Writes `croissant.json`, from the index and the card in the job; returns its path."""
    facts = card.facts(folder, index.read_index(folder.root).to_pylist())
    job, about, (width, height) = facts["job"], facts["card"], facts["job"].render.size
    summary = (
        f"{len(facts['done'])} rendered sequences of {job.frames} frames ({width} x {height} px) of a brain "
        "surface under load, with true motion, traction, force, depth and visibility."
    )
    base = json.loads(_BASE.read_text("utf-8"))
    table = (folder.root / index.NAME).read_bytes()
    base["distribution"][0] |= {"contentSize": f"{len(table)} B", "sha256": hashlib.sha256(table).hexdigest()}
    base["recordSet"][0]["field"] = [
        {
            "@type": "cr:Field",
            "@id": f"sequences/{column.name}",
            "name": column.name,
            "description": column.meaning + (f" [{column.unit}]" if column.unit != "-" else ""),
            "dataType": _TYPES[column.type],
            "source": {"fileObject": {"@id": "index"}, "extract": {"column": column.name}},
        }
        for column in index.COLUMNS
    ]
    creators = [{"@type": "sc:Person", "name": name} for name in about.authors]
    stated = {"creator": creators, "license": about.licence}
    fields = "; ".join(f"{field.name} [{field.unit}]: {field.meaning}" for field in FIELDS.values())
    described = {
        **base,
        "name": "".join(letter if letter.isalnum() else "-" for letter in about.title.lower()),
        "alternateName": about.title,
        "description": about.summary or summary,
        **{key: value for key, value in stated.items() if value},
        "rai:dataAnnotationProtocol": f"Labels are the simulation's own state. Fields: {fields}",
        "rai:dataLimitations": facts["limits"],
        "rai:dataBiases": [
            f"Appearance: {facts['families']}. Gestures: {facts['gestures']}. "
            f"Anatomies: {facts['anatomies']}."
        ],
    }
    path = folder.root / NAME
    write_whole(path, json.dumps(described, indent=1, ensure_ascii=False) + "\n")
    return path
