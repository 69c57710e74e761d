"""A page about a dataset that opens in any browser: thumbnails, distributions, failures, links."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from synth.dataset import index, location
from synth.dataset.folder import Folder, write_whole
from synth.dataset.store import Sequence, open_sequence
from synth.errors import UserError
from synth.publish import histogram

_THUMBNAILS = 24
_THUMBNAIL_PX = 320
_HISTOGRAMS = {
    "peak_force_mn": ("Peak force", "mN"),
    "young_kpa": ("Young's modulus", "kPa"),
    "peak_motion_mm": ("Peak motion", "mm"),
    "load": ("Load F/(E a²)", "1"),
    "poisson": ("Poisson's ratio", "1"),
    "cpu_s": ("Processor time a sequence", "s"),
}
_BARS = {"family": "Appearance", "gesture": "Gesture", "split": "Split"}


def write_report(root: Path, target: Path) -> Path:
    """Writes the page about the dataset in `root`; everything it shows is inside it."""
    import jinja2

    folder = Folder(root)
    described = folder.described()
    table = index.read_index(root)
    done = table.filter(pc.equal(table["status"], "done"))
    text = (Path(__file__).parent / "report.html.jinja").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    page = environment.from_string(text).render(
        title=folder.job().card.title,
        facts=_facts(table, done, folder.job().sequences),
        thumbnails=_thumbnails(root, done),
        charts=_charts(done),
        failures=_failures(table),
        links=[
            name for name in ("README.md", "preview.mp4", "job.yaml", index.NAME) if (root / name).exists()
        ],
        identity=described["identity"],
        dataset_hash=index.dataset_hash(done.select(["index", "status", "content_hash"]).to_pylist()),
    )
    write_whole(target, page)
    return target


def _facts(table: pa.Table, done: pa.Table, total: int) -> list[dict[str, str]]:
    frames = pc.sum(done["frames"]).as_py() or 0
    anatomies = pc.count_distinct(done["anatomy"]).as_py()
    hours = (pc.sum(done["cpu_s"]).as_py() or 0.0) / 3600
    named = {
        "sequences done": f"{len(done):,}",
        "asked for": f"{total:,}",
        "failed": f"{len(table) - len(done):,}",
        "frames": f"{frames:,}",
        "anatomies": f"{anatomies:,}",
        "CPU-hours": f"{hours:.3g}",
    }
    return [{"name": name, "value": value} for name, value in named.items()]


def _charts(done: pa.Table) -> list[str]:
    found = []
    for name, (title, unit) in _HISTOGRAMS.items():
        values = done[name].drop_null().to_numpy().astype(np.float64)
        if len(values):
            found.append(histogram.histogram(values, title, unit))
    for name, title in _BARS.items():
        counts = sorted(
            (one["values"], one["counts"]) for one in done[name].drop_null().value_counts().to_pylist()
        )
        if counts:
            found.append(histogram.bars([n for _, n in counts], [str(value) for value, _ in counts], title))
    return found


def _failures(table: pa.Table) -> list[dict[str, Any]]:
    failed = table.filter(pc.equal(table["status"], "failed"))
    grouped = failed.group_by("reason").aggregate([("index", "count"), ("index", "min")]).to_pylist()
    rows = [
        {"reason": row["reason"], "count": row["index_count"], "first": f"{row['index_min']:06d}"}
        for row in grouped
    ]
    return sorted(rows, key=lambda row: -int(row["count"]))[:50]


def _thumbnails(root: Path, done: pa.Table) -> list[dict[str, str]]:
    found = []
    for k in np.unique(np.linspace(0, max(len(done) - 1, 0), _THUMBNAILS).astype(int))[: len(done)]:
        row = done.slice(int(k), 1).to_pylist()[0]
        try:
            # Not by the path in the table, which may lead anywhere.
            place = location.store(root, int(row["index"]))
            sequence = open_sequence(place)
            jpeg = _jpeg(sequence)
        except UserError:
            continue  # moved away or damaged: `synth verify` is for that
        gesture, family = row["gesture"] or "-", row["family"] or "-"
        numbers = (
            "-" if row[name] is None else f"{row[name]:.3g} {unit}"
            for name, unit in (("peak_force_mn", "mN"), ("young_kpa", "kPa"))
        )
        caption = f"{row['index']:06d} {gesture}, {family}, {', '.join(numbers)}"
        found.append({"path": place.name, "jpeg": jpeg, "caption": caption})
    return found


def _jpeg(sequence: Sequence) -> str:
    from PIL import Image

    t = int(np.argmax(np.linalg.norm(sequence["force"][:], axis=1)))
    image = Image.fromarray(sequence["rgb"][t])
    image.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=80)
    return base64.b64encode(file.getvalue()).decode()
