"""The identity of a job: a hash that is equal exactly if the sequences are equal."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from synth.job.schema import Job
from synth.system import camera_file, checked_file

FILES: dict[tuple[str, str], int] = {
    ("anatomy", "mesh"): 1 << 30,
    ("appearance", "photo"): checked_file.LARGEST_PICTURE,
    ("render", "calibration"): camera_file.LARGEST_FILE,
}
"""Keys of a job that are paths, as (section, key), and the largest size of such a file in bytes."""


def canonical(value: Any) -> bytes:
    """JSON with sorted keys and no spaces; the same value gives the same bytes. ValueError for NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest(value: Any) -> str:
    """Hash of a value's canonical JSON. ValueError for NaN."""
    return hashlib.blake2b(canonical(value), digest_size=16).hexdigest()


def identify_job(job: Job) -> str:
    """Hash of everything that a sequence of `job` depends on except its index.

    Files enter by content, not by path. The card and the number of sequences don't enter: sequence 3 is the
    same in a dataset of 24 and of 48, so a dataset can be extended.
    """
    described = job.model_dump(mode="json")
    del described["sequences"], described["card"]
    for (block, name), largest in FILES.items():
        described[block][name] = _digest_file(getattr(getattr(job, block), name), largest)
    return digest(described)


def identify_anatomy(job: Job, seed: int) -> str:
    """Name of a sequence's geometry, equal in all datasets: a user's brain, or the seed of a procedural one.

    A brain is one anatomy for all its craniotomies and for all vessels drawn on it.
    """
    mesh = _digest_file(job.anatomy.mesh, FILES["anatomy", "mesh"])
    return f"seed-{seed}" if mesh is None else f"mesh-{mesh[:16]}"


def identify_opening(job: Job, index: int) -> str | None:
    """Name of the craniotomy of a user's brain, equal in all datasets; None for a procedural brain."""
    where = job.anatomy.opened(index).craniotomy
    if job.anatomy.mesh is None or where.point is None:
        return None
    return f"{identify_anatomy(job, 0)} at " + ", ".join(f"{value:g}" for value in where.point)


def _digest_file(path: Path | None, largest: int) -> str | None:
    if path is None:
        return None
    with checked_file.open_file(path, largest) as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
