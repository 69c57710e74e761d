"""The dataset in the formats of others: plain folders, WebDataset, HDF5, and the npz of published code."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.fields import FIELDS
from synth.system import whole_file

_SHARD_BYTES = 1 << 30
# The published loader drops nodes right of this pixel, and takes every file to have the nodes of the first.
_D2FNET_LARGEST_X = 1400.0
_D2FNET_NODES = 20_000


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
    dataset = Dataset(root)
    with whole_file.folder_of(target) as part:
        FORMATS[to](dataset, part)
    return len(dataset)


def folder(dataset: Dataset, target: Path) -> None:
    """`NNNNNN/rgb/TTTT.png`, other fields as `NNNNNN/FIELD.npy`, attributes as `NNNNNN/attributes.json`."""
    for sequence in dataset:
        here = target / f"{sequence.index:06d}"
        (here / "rgb").mkdir(parents=True)
        for t in range(sequence.frames):
            (here / "rgb" / f"{t:04d}.png").write_bytes(_png(sequence["rgb"][t]))
        for name in sequence.fields:
            if name != "rgb":
                np.save(here / f"{name}.npy", sequence[name][:])
        (here / "attributes.json").write_text(json.dumps(sequence.attrs, indent=1), "utf-8")


def webdataset(dataset: Dataset, target: Path) -> None:
    """Tar shards with a sample a frame: `NNNNNN_TTTT.rgb.png`, `.FIELD.npy` and `.json` (the attributes)."""
    samples, shard = _samples(dataset), 0
    pending = next(samples, None)
    while pending is not None:
        used = 0
        with tarfile.open(target / f"shard-{shard:05d}.tar", "w") as archive:
            while pending is not None and used <= _SHARD_BYTES:
                key, files = pending
                for name, data in files.items():
                    entry = tarfile.TarInfo(f"{key}.{name}")
                    entry.size = len(data)
                    archive.addfile(entry, io.BytesIO(data))
                    used += len(data)
                pending = next(samples, None)
        shard += 1


def hdf5(dataset: Dataset, target: Path) -> None:
    """`NNNNNN.h5` with the fields as datasets, a chunk a frame, and `attributes` as JSON."""
    try:
        import h5py
    except ImportError:
        raise UserError("HDF5 needs the package h5py: pip install h5py") from None
    for sequence in dataset:
        with h5py.File(target / f"{sequence.index:06d}.h5", "w") as file:
            file.attrs["attributes"] = json.dumps(sequence.attrs)
            for name in sequence.fields:
                values = sequence[name][:]
                chunks = (1, *values.shape[1:]) if FIELDS[name].framed else None
                packing = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if chunks else {}
                made = file.create_dataset(name, data=values, chunks=chunks, **packing)
                made.attrs["unit"], made.attrs["meaning"] = FIELDS[name].unit, FIELDS[name].meaning


def d2fnet_npz(dataset: Dataset, target: Path) -> None:
    """What the published training code globs: `run_NNNNNN/brain_surface_NNNNNN_auto_projected_NNNNNN_2d.npz`.

    Arrays as there (github.com/D3MIA/D2FNet, d2fnet/dataset.py): `disp2d` (T, N, 2) mm, `force_mag` (T, N) N,
    `projected_pixels` (T, N, 2) px. N is the same in every file, as that code needs. Displacement
    is in the picture's plane and not the world's, and `force_mag` is their "intensity" (peak = total force)
    made from the true traction; README.txt in the export says so.
    """
    count = min(int(sequence["tissue"][:].sum()) for sequence in dataset)
    count = min(count, _D2FNET_NODES)
    if not count:
        raise UserError(f"{dataset.root}: a sequence shows no tissue")
    for sequence in dataset:
        name = f"{sequence.index:06d}"
        (target / f"run_{name}").mkdir()
        path = target / f"run_{name}" / f"brain_surface_{name}_auto_projected_{name}_2d.npz"
        moved, pressed, seen = _d2fnet_arrays(sequence, count)
        np.savez_compressed(path, disp2d=moved, force_mag=pressed, projected_pixels=seen)
    (target / "README.txt").write_text(_D2FNET_NOTE, "utf-8")


def _d2fnet_arrays(sequence: Sequence, count: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    pixels = np.argwhere(sequence["tissue"][:])
    rows, columns = pixels[np.linspace(0, len(pixels) - 1, count).round().astype(int)].T
    scale = float(sequence.attrs["scale_mm_per_px"])
    shrink = min(1.0, _D2FNET_LARGEST_X / sequence.size[1])
    force = np.linalg.norm(sequence["force"][:], axis=1)
    moved = np.empty((sequence.frames, count, 2), np.float32)
    pressed = np.zeros((sequence.frames, count), np.float32)
    seen = np.empty_like(moved)
    rest = np.stack([columns, rows], axis=-1)
    for t in range(sequence.frames):
        flow = sequence["flow"][t][rows, columns]
        size = np.linalg.norm(sequence["traction"][t], axis=-1)
        moved[t] = scale * flow
        seen[t] = shrink * (rest + flow)
        if size.max() > 0:
            pressed[t] = size[rows, columns] / size.max() * force[t] / 1000
    return moved, pressed, seen


_D2FNET_NOTE = """\
Layout of github.com/D3MIA/D2FNet: disp2d (T, N, 2) mm, force_mag (T, N) N, projected_pixels (T, N, 2) px.
disp2d is the motion in the picture's plane times the scale, not world x and y.
force_mag is the "intensity" map, its peak scaled to the total force; the true traction is in the Zarr stores.
"""

FORMATS: dict[str, Callable[[Dataset, Path], None]] = {
    "folder": folder,
    "webdataset": webdataset,
    "hdf5": hdf5,
    "d2fnet-npz": d2fnet_npz,
}
"""Every format by the name that `synth export --to` takes."""


def _samples(dataset: Dataset) -> Iterator[tuple[str, dict[str, bytes]]]:
    for sequence in dataset:
        attributes = json.dumps(sequence.attrs).encode()
        for t in range(sequence.frames):
            yield f"{sequence.index:06d}_{t:04d}", {**_frame(sequence, t), "json": attributes}


def _frame(sequence: Sequence, t: int) -> dict[str, bytes]:
    found = {}
    for name in sequence.fields:
        if name == "rgb":
            found["rgb.png"] = _png(sequence["rgb"][t])
        elif FIELDS[name].dims[0] == "frame":
            found[f"{name}.npy"] = _npy(np.asarray(sequence[name][t]))
        else:
            found[f"{name}.npy"] = _npy(sequence[name][:])
    return found


def _png(picture: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=3)
    return file.getvalue()


def _npy(values: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()
