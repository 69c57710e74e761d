"""Export to WebDataset: tar shards with a sample per frame (github.com/webdataset/webdataset)."""

from __future__ import annotations

import io
import itertools
import json
import tarfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from synth.dataset.index import group_by_side
from synth.dataset.store import Dataset
from synth.fields import FIELDS, TIME
from synth.publish.export.encoding import PICTURES, as_npy, as_png

_SHARD_BYTES = 1 << 30


def write_shards(dataset: Dataset, target: Path) -> None:
    """Writes `SIDE-NNNNN.tar` with a sample per frame: `NNNNNN_TTTT.rgb.png`, `.FIELD.npy` and `.json`.

    Pictures of a right camera are `.rgb_right.png`; `.json` contains the attributes.
    """
    for side, positions in group_by_side(dataset).items():
        samples, shards = _samples(dataset, positions), itertools.count()
        for first in samples:
            with tarfile.open(target / f"{side}-{next(shards):05d}.tar", "w") as archive:
                used = 0
                for files in itertools.chain([first], samples):
                    for name, data in files.items():
                        entry = tarfile.TarInfo(name)
                        entry.size = len(data)
                        archive.addfile(entry, io.BytesIO(data))
                        used += len(data)
                    if used > _SHARD_BYTES:
                        break


def _samples(dataset: Dataset, positions: Iterable[int]) -> Iterator[dict[str, bytes]]:
    """The files of each sample."""
    for sequence in map(dataset.__getitem__, positions):
        attributes = json.dumps(sequence.attrs).encode()
        for t in range(sequence.frames):
            key, files = f"{sequence.index:06d}_{t:04d}", {}
            for name in sequence.fields:
                values = sequence[name][t if FIELDS[name].dims[0] == TIME else slice(None)]
                encoded, ending = (as_png, "png") if name in PICTURES else (as_npy, "npy")
                files[f"{key}.{name}.{ending}"] = encoded(values)
            yield {**files, f"{key}.json": attributes}
