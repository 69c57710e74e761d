"""A page about a dataset that opens in any browser: thumbnails, the card's figures, failures, links."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset import index, location
from synth.dataset.folder import Folder, write_whole
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.publish import card, picture

_THUMBNAILS, _THUMBNAIL_PX = 24, 320
_FILES = ("README.md", "preview.mp4", "job.yaml", index.NAME)


def write_report(root: Path, target: Path) -> Path:
    """Writes the page about the dataset in `root`; everything it shows is inside it."""
    about = card.facts(Folder(root))
    done = about["done"]
    chosen = np.unique(np.linspace(0, max(len(done) - 1, 0), _THUMBNAILS).astype(int))[: len(done)]
    page = card.template("report.html.jinja").render(
        **about,
        thumbnails=[found for k in chosen if (found := _thumbnail(root, done[k])) is not None],
        links=[name for name in _FILES if (root / name).exists()],
    )
    write_whole(target, page)
    return target


def _thumbnail(root: Path, row: dict[str, Any]) -> dict[str, str] | None:
    """A sequence at its greatest load; None of one that was moved away or is damaged."""
    from PIL import Image

    try:
        # Not by the path in the table, which may lead anywhere.
        place = location.store(root, int(row["index"]))
        sequence = open_sequence(place)
        image = Image.fromarray(sequence["rgb"][picture.strongest(sequence)])
    except UserError:
        return None  # `synth verify` is for that
    image.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=80)
    numbers = [
        f"{row[name]:.3g} {unit}" for name, (_, unit) in card.QUANTITIES.items() if row[name] is not None
    ]
    caption = ", ".join([f"{row['index']:06d} {row['gesture'] or '-'}", row["family"] or "-", *numbers[:2]])
    return {"path": place.name, "jpeg": base64.b64encode(file.getvalue()).decode(), "caption": caption}
