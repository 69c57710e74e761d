"""`synth export`: the formats by their names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from synth.errors import UserError, as_user_error
from synth.plugins import Registry

_BUILTIN = {
    "folder": "plain:write_folder",
    "hf": "hugging_face:write_parquet",
    "webdataset": "webdataset:write_shards",
    "endonerf": "endonerf:write_scenes",
    "tapvid": "tapvid:write_tracks",
    "flow-pairs": "flow_pairs:write_pairs",
    "hdf5": "plain:write_hdf5",
    "d2fnet-npz": "d2fnet_layout:write_npz",
    "vtu": "vtu:write_meshes",
}
_PLACES = {name: f"synth.publish.export.{place}" for name, place in _BUILTIN.items()}
_PLACES["video"] = "synth.publish.sequence_video:write_videos"

EXPORTERS = Registry("sulcus.exporters", "--to", "format", _PLACES)
"""All formats by their names in `synth export --to`. An entry point is a function of a `synth.Dataset` and a
folder (a `Path`, which exists and is empty) that writes the dataset's sequences into the folder."""


def export_dataset(root: Path, target: Path, to: str, **options: Any) -> int:
    """Exports the finished sequences of `root` to the new folder `target`; returns their number.

    In addition to the files of the format, one of `EXPORTERS`, `split.csv` contains the side of each sequence
    in the dataset's split. `target` is written as a whole or not at all. `options`: `overlays` and
    `interval_s` of a video. Raises UserError for an unknown format, an existing folder, a damaged store, a
    missing package, or any exception of a plug-in.
    """
    # Here: the command line lists the formats in its help.
    from synth.dataset.index import group_by_side
    from synth.dataset.store import Dataset
    from synth.system import checked_file

    if to not in EXPORTERS.names():
        raise UserError(f"{to}: is not one of {', '.join(EXPORTERS.names())}")
    write, dataset = EXPORTERS.load_as_is(to), Dataset(root)
    with checked_file.folder_of(target) as folder:
        if to in EXPORTERS.builtin:
            write(dataset, folder, **options)
        else:
            with as_user_error(EXPORTERS.label(to)):
                write(dataset, folder, **options)
        side_of = {
            dataset[k].index: side for side, positions in group_by_side(dataset).items() for k in positions
        }
        lines = [f"{number:06d},{side_of[number]}\n" for number in sorted(side_of)]
        (folder / "split.csv").write_text("sequence,split\n" + "".join(lines), "utf-8")
    return len(dataset)
