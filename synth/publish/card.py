"""What describes a dataset to a person: its card README.md with pictures, and a page for browsers."""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset import index, location, split
from synth.dataset.folder import Folder, write_whole
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.fields import FIELDS
from synth.publish import picture, svg

QUANTITIES = {
    "peak_force_mn": ("Peak force", "mN"),
    "young_kpa": ("Young's modulus", "kPa"),
    "peak_motion_mm": ("Peak motion", "mm"),
    "load": ("Load F/(E a²)", "1"),
}
"""Columns of the index that card and page draw: title and unit."""

_THUMBNAILS, _THUMBNAIL_PX = 24, 320
_FILES = ("README.md", "preview.mp4", "job.yaml", index.NAME)
_FEWEST_DRAWN = 5
"""Of less a histogram says nothing that the table of ranges doesn't, and drawing takes a second."""


def write_card(folder: Folder) -> Path:
    """Writes README.md and the pictures it shows, from the index and the sequences. Returns its path."""
    about = facts(folder)
    done, pictures = about["done"], folder.root / "card"
    pictures.mkdir(exist_ok=True)
    for name, chart in about["charts"].items():
        write_whole(pictures / f"{name}.svg", chart)
    best = max(done, key=lambda row: row["peak_flow_px"] or 0.0, default=None)
    attrs, fields = dict[str, Any](), list(FIELDS)
    if best is not None:
        from PIL import Image

        sequence = open_sequence(location.store(folder.root, best["index"]))
        attrs, fields = sequence.attrs, sequence.fields
        drawn = picture.draw_sequence(sequence, [picture.strongest(sequence)])
        Image.fromarray(drawn).save(pictures / "example.png")
    text = template("card.md.jinja").render(
        **about,
        example=best,
        preview=(folder.root / "preview.mp4").exists(),
        variant=attrs.get("variant", "-"),
        versions=attrs.get("versions", {}),
        ranges=[_range(done, name) for name in QUANTITIES],
        fields=[FIELDS[name] for name in fields],
        columns=index.COLUMNS,
        limits=limits(folder),
    )
    path = folder.root / "README.md"
    write_whole(path, text)
    return path


def write_page(root: Path, target: Path) -> Path:
    """Writes a page about the dataset in `root` that any browser opens; all that it shows is inside it."""
    about = facts(Folder(root))
    done = about["done"]
    chosen = np.unique(np.linspace(0, max(len(done) - 1, 0), _THUMBNAILS).astype(int))[: len(done)]
    thumbnails = [found for k in chosen if (found := _thumbnail(root, done[k])) is not None]
    links = [name for name in _FILES if (root / name).exists()]
    page = template("report.html.jinja").render(**about, thumbnails=thumbnails, links=links)
    write_whole(target, page)
    return target


def facts(folder: Folder) -> dict[str, Any]:
    """What card and page both say of a dataset, from its job and its index."""
    rows, job = index.read_index(folder.root).to_pylist(), folder.job()
    done = [row for row in rows if row["status"] == "done"]
    failed = [row for row in rows if row["status"] == "failed"]
    reasons = Counter(row["reason"] for row in failed)
    first = {row["reason"]: row["index"] for row in reversed(failed)}
    drawn = {name: (column(done, name), *words) for name, words in QUANTITIES.items()}
    return {
        "job": job,
        "card": job.card,
        "done": done,
        "failed": [(count, reason, first[reason]) for reason, count in reasons.most_common(50)],
        "frames": sum(row["frames"] for row in done),
        "anatomies": len({row["anatomy"] for row in done}),
        "families": share(done, "family"),
        "gestures": share(done, "gesture"),
        "splits": share(done, "split"),
        "split_hash": split.read_stored(folder.root).hash,
        "cpu_h": column(done, "cpu_s").sum() / 3600,
        "charts": {name: svg.histogram(*one) for name, one in drawn.items() if len(one[0]) >= _FEWEST_DRAWN},
        "quantities": QUANTITIES,
        "identity": folder.described()["identity"],
        "dataset_hash": index.dataset_hash(rows),
    }


def limits(folder: Folder) -> list[str]:
    """What a reader must know before trusting the data, given how it was made."""
    job = folder.job()
    text: str = template("limits.jinja").render(
        job=job,
        versions=len(folder.described()["generators"]),
        shared=split.read_stored(folder.root).share_anatomy,
    )
    return [line for line in text.splitlines() if line]


def column(rows: Iterable[Mapping[str, Any]], name: str) -> NDArray[np.float64]:
    """The numbers of one column that are there, (n,)."""
    return np.array([row[name] for row in rows if row.get(name) is not None], np.float64)


def share(rows: Iterable[Mapping[str, Any]], name: str) -> str:
    """How often each value of a column occurs: "pull 12, push 9"."""
    counts = Counter(str(row[name]) for row in rows if row.get(name) is not None)
    return ", ".join(f"{value} {count}" for value, count in sorted(counts.items())) or "-"


def template(name: str) -> Any:
    """A page of this room, ready to render; what is put into HTML is escaped."""
    import jinja2

    text = (Path(__file__).parent / name).read_text("utf-8")
    escaped = name.endswith(".html.jinja")
    return jinja2.Environment(
        trim_blocks=True, undefined=jinja2.StrictUndefined, autoescape=escaped
    ).from_string(text)


def _range(rows: list[dict[str, Any]], name: str) -> list[str]:
    """Name, least, median and greatest."""
    values, (title, unit) = column(rows, name), QUANTITIES[name]
    ends = np.quantile(values, (0, 0.5, 1)).tolist() if len(values) else []
    return [f"{title} [{unit}]", *([f"{value:.3g}" for value in ends] or ["-"] * 3)]


def _thumbnail(root: Path, row: dict[str, Any]) -> dict[str, str] | None:
    """A sequence at its greatest load; None of one that was moved away or is damaged."""
    from PIL import Image

    # Not by the path in the table, which may lead anywhere.
    path = location.store(root, int(row["index"]))
    try:
        sequence = open_sequence(path)
        image = Image.fromarray(sequence["rgb"][picture.strongest(sequence)])
    except UserError:
        return None  # `synth verify` is for that
    image.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=80)
    numbers = [f"{row[name]:.3g} {unit}" for name, (_, unit) in QUANTITIES.items() if row[name] is not None]
    caption = ", ".join([f"{row['index']:06d} {row['gesture'] or '-'}", row["family"] or "-", *numbers[:2]])
    return {"path": path.name, "jpeg": base64.b64encode(file.getvalue()).decode(), "caption": caption}
