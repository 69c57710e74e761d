"""WebDataset: tar shards, a sample a frame (github.com/webdataset/webdataset)."""

from __future__ import annotations

import io
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
    """Tar shards with a sample a frame: `NNNNNN_TTTT.rgb.png`, `.FIELD.npy` and `.json` (the attributes).

    A second lens's pictures are `.rgb_right.png`. Shards are `SIDE-NNNNN.tar`, sides as `synth split` said.
    """
    for side, positions in group_by_side(dataset).items():
        samples, shard = _samples(dataset, positions), 0
        pending = next(samples, None)
        while pending is not None:
            used = 0
            with tarfile.open(target / f"{side}-{shard:05d}.tar", "w") as archive:
                while pending is not None and used <= _SHARD_BYTES:
                    key, files = pending
                    for name, data in files.items():
                        entry = tarfile.TarInfo(f"{key}.{name}")
                        entry.size = len(data)
                        archive.addfile(entry, io.BytesIO(data))
                        used += len(data)
                    pending = next(samples, None)
            shard += 1


def _samples(dataset: Dataset, positions: Iterable[int]) -> Iterator[tuple[str, dict[str, bytes]]]:
    for sequence in map(dataset.__getitem__, positions):
        attributes = json.dumps(sequence.attrs).encode()
        for t in range(sequence.frames):
            files = {}
            for name in sequence.fields:
                values = sequence[name][t if FIELDS[name].dims[0] == TIME else slice(None)]
                picture = name in PICTURES
                files[f"{name}.png" if picture else f"{name}.npy"] = (as_png if picture else as_npy)(values)
            yield f"{sequence.index:06d}_{t:04d}", {**files, "json": attributes}
