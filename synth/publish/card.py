"""Descriptions of a dataset for people: its card README.md with pictures, and an HTML page."""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.dataset import index, location, split
from synth.dataset.folder import Folder, write_whole
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.fields import FIELDS
from synth.publish import picture, svg

QUANTITIES = {column.name: column for column in index.COLUMNS if column.title}
"""Columns of the index that are drawn in card and page."""

_THUMBNAILS, _THUMBNAIL_PX = 24, 320
_FILES = ("README.md", "preview.mp4", "job.yaml", index.NAME)
_FEWEST_DRAWN = 5  # a histogram of fewer sequences adds nothing to the table of ranges


def write_card(folder: Folder) -> Path:
    """Writes README.md and its pictures, from the index and the sequences. Returns its path."""
    about = facts(folder, index.read_index(folder.root).to_pylist())
    done, pictures = about["done"], folder.root / "card"
    charts = _charts(done)
    pictures.mkdir(exist_ok=True)
    for name, chart in charts.items():
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
        charts=charts,
        example=best,
        preview=(folder.root / "preview.mp4").exists(),
        variant=attrs.get("variant", "-"),
        versions=attrs.get("versions", {}),
        quantities=QUANTITIES,
        ranges=[_range(done, one) for one in QUANTITIES.values()],
        fields=[FIELDS[name] for name in fields],
        columns=index.COLUMNS,
    )
    path = folder.root / "README.md"
    write_whole(path, text)
    return path


def write_page(root: Path, target: Path) -> Path:
    """Writes a self-contained HTML page about the dataset in `root`. Returns its path."""
    about = facts(Folder(root), index.read_index(root).to_pylist())
    done = about["done"]
    chosen = np.unique(np.linspace(0, max(len(done) - 1, 0), _THUMBNAILS).astype(int))[: len(done)]
    thumbnails = [found for k in chosen if (found := _thumbnail(root, done[k])) is not None]
    links = [name for name in _FILES if (root / name).exists()]
    page = template("report.html.jinja")
    write_whole(target, page.render(**about, charts=_charts(done), thumbnails=thumbnails, links=links))
    return target


def facts(folder: Folder, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Values for the templates of all descriptions, from the dataset's job and the rows of an index."""
    job = folder.job()
    described, stored = folder.described(), split.read_stored(folder.root)
    done = [row for row in rows if row["status"] == "done"]
    failed = [row for row in rows if row["status"] == "failed"]
    reasons = Counter(row["reason"] for row in failed)
    first = {row["reason"]: row["index"] for row in reversed(failed)}
    limits = template("limits.jinja").render(
        job=job, versions=len(described["generators"]), shared=stored.share_anatomy
    )
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
        "split_hash": stored.hash,
        "cpu_h": column(done, "cpu_s").sum() / 3600,
        "identity": described["identity"],
        "dataset_hash": index.dataset_hash(rows),
        "limits": [line for line in limits.splitlines() if line],
    }


def _charts(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Histograms of `QUANTITIES` by name, as SVG."""
    drawn = {name: (column(rows, name), one.title, one.unit) for name, one in QUANTITIES.items()}
    return {name: svg.histogram(*one) for name, one in drawn.items() if len(one[0]) >= _FEWEST_DRAWN}


def column(rows: Iterable[Mapping[str, Any]], name: str) -> Floats:
    """The values (n,) of one column, without missing ones."""
    return np.array([row[name] for row in rows if row.get(name) is not None], np.float64)


def share(rows: Iterable[Mapping[str, Any]], name: str) -> str:
    """Counts of the values of a column: "pull 12, push 9"."""
    counts = Counter(str(row[name]) for row in rows if row.get(name) is not None)
    return ", ".join(f"{value} {count}" for value, count in sorted(counts.items())) or "-"


def template(name: str) -> Any:
    """A template of this package; values are escaped in HTML."""
    import jinja2

    loader, escaped = jinja2.FileSystemLoader(Path(__file__).parent), name.endswith(".html.jinja")
    strict: Any = {"trim_blocks": True, "undefined": jinja2.StrictUndefined}
    return jinja2.Environment(loader=loader, autoescape=escaped, **strict).get_template(name)


def _range(rows: list[dict[str, Any]], quantity: index.IndexColumn) -> list[str]:
    """Title, minimum, median and maximum."""
    values = column(rows, quantity.name)
    ends = np.quantile(values, (0, 0.5, 1)).tolist() if len(values) else []
    return [f"{quantity.title} [{quantity.unit}]", *([f"{value:.3g}" for value in ends] or ["-"] * 3)]


def _thumbnail(root: Path, row: dict[str, Any]) -> dict[str, str] | None:
    """A sequence at its greatest load; None if it is missing or damaged."""
    from PIL import Image

    # Not the path in the table, which is untrusted.
    path = location.store(root, int(row["index"]))
    try:
        sequence = open_sequence(path)
        image = Image.fromarray(sequence["rgb"][picture.strongest(sequence)])
    except UserError:
        return None  # damage is reported by `synth verify`
    image.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=80)
    shown = [QUANTITIES[name] for name in ("peak_force_mn", "young_kpa") if row[name] is not None]
    numbers = [f"{row[one.name]:.3g} {one.unit}" for one in shown]
    caption = ", ".join([f"{row['index']:06d} {row['gesture'] or '-'}", row["family"] or "-", *numbers])
    return {"path": path.name, "jpeg": base64.b64encode(file.getvalue()).decode(), "caption": caption}
