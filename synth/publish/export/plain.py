"""Exports as plain files: folders of PNG and .npy, and HDF5."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.fields import FIELDS
from synth.publish.export.encoding import PICTURES, write_exr, write_png


def write_folder(dataset: Dataset, target: Path) -> None:
    """Writes `NNNNNN/rgb/TTTT.png`, other fields as `NNNNNN/FIELD.npy`, and `NNNNNN/attributes.json`.

    The right camera's pictures are in `NNNNNN/rgb_right/`, linear light in `NNNNNN/radiance/TTTT.exr`.
    """
    for sequence in dataset:
        folder = target / f"{sequence.index:06d}"
        folder.mkdir()
        for name in sequence.fields:
            if name not in (*PICTURES, "radiance"):
                np.save(folder / f"{name}.npy", sequence[name][:])
                continue
            for t in range(sequence.frames):
                write, ending = (write_png, "png") if name in PICTURES else (write_exr, "exr")
                write(folder / name / f"{t:04d}.{ending}", sequence[name][t])
        (folder / "attributes.json").write_text(json.dumps(sequence.attrs, indent=1), "utf-8")


def write_hdf5(dataset: Dataset, target: Path) -> None:
    """Writes `NNNNNN.h5` with the fields as datasets, a chunk per frame, and `attributes` as JSON."""
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
                field = file.create_dataset(name, data=values, chunks=chunks, **packing)
                field.attrs["unit"], field.attrs["meaning"] = FIELDS[name].unit, FIELDS[name].meaning
