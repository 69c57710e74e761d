"""`synth export`: every format by its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.publish.export import d2fnet, endonerf, hugging_face, lerobot, overlay_video, plain, webdataset
from synth.system import whole_file

FORMATS: dict[str, Callable[[Dataset, Path], None]] = {
    "folder": plain.write_folder,
    "hf": hugging_face.write_parquet,
    "webdataset": webdataset.write_shards,
    "lerobot": lerobot.write_episodes,
    "endonerf": endonerf.write_scenes,
    "hdf5": plain.write_hdf5,
    "d2fnet-npz": d2fnet.write_npz,
    "video": overlay_video.write_films,
}
"""Every format by the name that `synth export --to` takes."""


def export_dataset(root: Path, target: Path, to: str) -> int:
    """Writes the finished sequences of `root` into the new folder `target`; returns how many.

    Args:
        root: the dataset.
        target: a folder that does not exist yet; it is there in full or not at all.
        to: one of `FORMATS`.

    Raises:
        UserError: an unknown format, a folder that exists, a damaged store, a missing package.
    """
    if to not in FORMATS:
        raise UserError(f"{to}: is not one of {', '.join(FORMATS)}")
    return write_export(root, target, FORMATS[to])


def write_export(root: Path, target: Path, write: Callable[[Dataset, Path], None]) -> int:
    """The same with a writer that has been told more."""
    dataset = Dataset(root)
    with whole_file.folder_of(target) as part:
        write(dataset, part)
    return len(dataset)
