"""The description of a dataset for people: its card README.md with a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.dataset import index, location, sequence_split
from synth.dataset.dataset_folder import Folder, write_whole
from synth.dataset.store import open_sequence
from synth.fields import FIELDS
from synth.publish import picture

QUANTITIES = {column.name: column for column in index.COLUMNS if column.title}
"""Columns of the index whose ranges the card states."""


def write_card(folder: Folder) -> Path:
    """Writes README.md and its picture, from the index and the sequences. Returns its path."""
    values = facts(folder, index.read_index(folder.root).to_pylist())
    done, pictures = values["done"], folder.root / "card"
    pictures.mkdir(exist_ok=True)
    example = max(done, key=lambda row: row["peak_flow_px"] or 0.0, default=None)
    attrs, fields = dict[str, Any](), list(FIELDS)
    if example is not None:
        from PIL import Image

        sequence = open_sequence(location.store(folder.root, example["index"]))
        attrs, fields = sequence.attrs, sequence.fields
        image = picture.draw_sequence(sequence, [picture.find_strongest(sequence)])
        Image.fromarray(image).save(pictures / "example.png")
    text = template("card.md.jinja").render(
        **values,
        example=example,
        variant=attrs.get("variant", "-"),
        versions=attrs.get("versions", {}),
        ranges=[_range(done, quantity) for quantity in QUANTITIES.values()],
        fields=[FIELDS[name] for name in fields],
        columns=index.COLUMNS,
    )
    path = folder.root / "README.md"
    write_whole(path, text)
    return path


def facts(folder: Folder, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Values for the templates of all descriptions, from the dataset's job and the rows of an index."""
    job = folder.job()
    description, split = folder.read_description(), sequence_split.read_stored(folder.root)
    done = [row for row in rows if row["status"] == "done"]
    failed = [row for row in rows if row["status"] == "failed"]
    reasons = Counter(row["reason"] for row in failed)
    first = {row["reason"]: row["index"] for row in reversed(failed)}
    limits = template("limits.jinja").render(
        job=job, versions=len(description["generators"]), shared=split.share_anatomy
    )
    return {
        "job": job,
        "card": job.card,
        "done": done,
        "redrawn": sum(bool(row.get("attempt")) for row in done),
        "failed": [(count, reason, first[reason]) for reason, count in reasons.most_common(50)],
        "frames": sum(row["frames"] for row in done),
        "anatomies": len({row["anatomy"] for row in done}),
        "families": share(done, "family"),
        "gestures": share(done, "gesture"),
        "splits": share(done, "split"),
        "split_hash": split.hash,
        "cpu_h": column(done, "cpu_s").sum() / 3600,
        "identity": description["identity"],
        "dataset_hash": index.dataset_hash(rows),
        "limits": [line for line in limits.splitlines() if line],
    }


def column(rows: Iterable[Mapping[str, Any]], name: str) -> Floats:
    """The values (n,) of one column, without missing ones."""
    return np.array([row[name] for row in rows if row.get(name) is not None], np.float64)


def share(rows: Iterable[Mapping[str, Any]], name: str) -> str:
    """Counts of the values of a column: "pull 12, push 9"."""
    counts = Counter(str(row[name]) for row in rows if row.get(name) is not None)
    return ", ".join(f"{value} {count}" for value, count in sorted(counts.items())) or "-"


def template(name: str) -> Any:
    """A template of this package, in Markdown or text."""
    import jinja2

    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    strict: Any = {"trim_blocks": True, "undefined": jinja2.StrictUndefined}
    return jinja2.Environment(loader=loader, **strict).get_template(name)


def _range(rows: list[dict[str, Any]], quantity: index.IndexColumn) -> list[str]:
    """Title, minimum, median and maximum."""
    values = column(rows, quantity.name)
    ends = np.quantile(values, (0, 0.5, 1)).tolist() if len(values) else []
    return [f"{quantity.title} [{quantity.unit}]", *([f"{value:.3g}" for value in ends] or ["-"] * 3)]
