"""`synth export`: the formats by their names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from synth.dataset.index import group_by_side
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.publish import sequence_video
from synth.publish.export import (
    d2fnet,
    endonerf,
    flow_pairs,
    hugging_face,
    lerobot,
    plain,
    tapvid,
    vtu,
    webdataset,
)
from synth.system import checked_file

FORMATS: dict[str, Callable[..., None]] = {
    "folder": plain.write_folder,
    "hf": hugging_face.write_parquet,
    "webdataset": webdataset.write_shards,
    "lerobot": lerobot.write_episodes,
    "endonerf": endonerf.write_scenes,
    "tapvid": tapvid.write_tracks,
    "flow-pairs": flow_pairs.write_pairs,
    "hdf5": plain.write_hdf5,
    "d2fnet-npz": d2fnet.write_npz,
    "vtu": vtu.write_meshes,
    "video": sequence_video.write_videos,
}
"""All formats by their names in `synth export --to`."""


def export_dataset(root: Path, target: Path, to: str, **options: Any) -> int:
    """Exports the finished sequences of `root` to the new folder `target`; returns their number.

    In addition to the files of the format, one of `FORMATS`, `split.csv` contains the side of each sequence
    in the dataset's split. `target` is written as a whole or not at all. `options`: `overlays` and
    `interval_s` of a video. Raises UserError for an unknown format, an existing folder, a damaged store, or a
    missing package.
    """
    if to not in FORMATS:
        raise UserError(f"{to}: is not one of {', '.join(FORMATS)}")
    dataset = Dataset(root)
    with checked_file.folder_of(target) as part:
        FORMATS[to](dataset, part, **options)
        on = {dataset[k].index: side for side, those in group_by_side(dataset).items() for k in those}
        lines = [f"{number:06d},{on[number]}\n" for number in sorted(on)]
        (part / "split.csv").write_text("sequence,split\n" + "".join(lines), "utf-8")
    return len(dataset)
