"""The dataset described for machines: Croissant 1.1 (mlcommons.org/croissant) with Responsible AI fields."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from synth.dataset import index
from synth.dataset.folder import Folder, write_whole
from synth.fields import FIELDS
from synth.job.schema import Card, Job
from synth.publish import card

NAME = "croissant.json"

REQUIRED = (
    "@context",
    "@type",
    "name",
    "description",
    "conformsTo",
    "version",
    "creator",
    "license",
    "url",
    "datePublished",
    "distribution",
    "recordSet",
    "rai:dataCollection",
    "rai:dataCollectionType",
    "rai:dataLimitations",
    "rai:dataBiases",
    "rai:dataUseCases",
    "rai:personalSensitiveInformation",
    "rai:dataAnnotationProtocol",
    "rai:dataPreprocessingProtocol",
)
"""Keys that a description must have; public validators accept some of them missing."""

_TYPES = {
    pa.int64(): "sc:Integer",
    pa.float64(): "sc:Float",
    pa.string(): "sc:Text",
}


def write_croissant(folder: Folder) -> Path:
    """Writes `croissant.json` beside the index. Returns its path."""
    path = folder.root / NAME
    text = json.dumps(describe(folder), indent=1, ensure_ascii=False) + "\n"
    write_whole(path, text)
    return path


def describe(folder: Folder) -> dict[str, Any]:
    """The description, JSON-LD. Everything is taken from the dataset; prose is what its job's card says."""
    job, rows = folder.job(), index.read_index(folder.root).to_pylist()
    done = [row for row in rows if row["status"] == "done"]
    about = job.card
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [
            "http://mlcommons.org/croissant/1.1",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
        "name": "".join(letter if letter.isalnum() else "-" for letter in about.title.lower()),
        "alternateName": about.title,
        "description": about.summary or _summary(job, len(done)),
        "version": "1.0.0",
        **_stated(about),
        "keywords": ["synthetic", "neurosurgery", "optical flow", "force estimation", "finite elements"],
        "citeAs": "Heraoui et al., Vision-Based Force Estimation Using Brain Surface Deformation Models",
        "isLiveDataset": False,
        "distribution": _distribution(folder),
        "recordSet": [_sequences()],
        "rai:dataCollection": "Simulated and rendered from a job file; nothing was recorded.",
        "rai:dataCollectionType": ["Software Collection"],
        "rai:dataAnnotationProtocol": "Labels are the simulation's own state. Fields: " + _fields(),
        "rai:dataPreprocessingProtocol": ["None: sensor noise and 8-bit sRGB are part of the rendering."],
        "rai:dataLimitations": card.limits(folder),
        "rai:dataBiases": [
            f"Appearance: {card.share(done, 'family')}. Gestures: {card.share(done, 'gesture')}. "
            f"Anatomies: {len({row['anatomy'] for row in done})}."
        ],
        "rai:dataUseCases": ["Training and testing of motion and force estimation from surgical video."],
        "rai:personalSensitiveInformation": ["None: no person, patient or animal was recorded."],
    }


def missing(described: Mapping[str, Any]) -> list[str]:
    """Required keys that are absent or empty."""
    return [key for key in REQUIRED if not described.get(key)]


def _stated(about: Card) -> dict[str, Any]:
    """What only a person can say; what was not said is left out rather than made up."""
    creators = [{"@type": "sc:Person", "name": name} for name in about.authors]
    found = {
        "creator": creators,
        "license": about.licence,
        "url": about.url,
        "datePublished": about.published,
    }
    return {key: value for key, value in found.items() if value}


def _summary(job: Job, count: int) -> str:
    width, height = job.render.size
    return (
        f"{count} rendered sequences of {job.frames} frames ({width} x {height} px) of a brain surface under "
        "load, with true motion, traction, force, depth and visibility."
    )


def _fields() -> str:
    return "; ".join(f"{field.name} [{field.unit}]: {field.meaning}" for field in FIELDS.values())


def _distribution(folder: Folder) -> list[dict[str, Any]]:
    data = (folder.root / index.NAME).read_bytes()
    return [
        {
            "@type": "cr:FileObject",
            "@id": "index",
            "name": "index",
            "description": "One row a sequence.",
            "contentUrl": index.NAME,
            "contentSize": f"{len(data)} B",
            "encodingFormat": "application/x-parquet",
            "sha256": hashlib.sha256(data).hexdigest(),
        },
        {
            "@type": "cr:FileSet",
            "@id": "stores",
            "name": "stores",
            "description": "Zarr v3 groups, one a sequence; column path of the index names them.",
            "encodingFormat": "application/vnd.zarr",
            "includes": "*.zarr/**",
        },
    ]


def _sequences() -> dict[str, Any]:
    fields = []
    for column in index.SCHEMA:
        notes = {key.decode(): value.decode() for key, value in (column.metadata or {}).items()}
        unit = f" [{notes['unit']}]" if "unit" in notes else ""
        fields.append(
            {
                "@type": "cr:Field",
                "@id": f"sequences/{column.name}",
                "name": column.name,
                "description": notes["meaning"] + unit,
                "dataType": _TYPES[column.type],
                "source": {"fileObject": {"@id": "index"}, "extract": {"column": column.name}},
            }
        )
    return {
        "@type": "cr:RecordSet",
        "@id": "sequences",
        "name": "sequences",
        "description": "The index.",
        "key": {"@id": "sequences/index"},
        "field": fields,
    }


# The context that the specification gives, with the prefix of its Responsible AI vocabulary.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "equivalentProperty": "cr:equivalentProperty",
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
