"""A store as an older version of the program wrote it: with a field under its former name."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import zarr


def rename_field(path: Path, name: str = "flow_recovered", former: str = "flow_tvl1") -> None:
    """Gives a field of the sealed store at `path` its former name, in the hashes and the seal too."""
    (path / name).rename(path / former)
    group = zarr.open_group(str(path), mode="r+")
    array, attrs = group[former], dict(group.attrs)
    assert isinstance(array, zarr.Array)
    described = _canonical([former, str(array.dtype), list(array.shape)])
    values = np.ascontiguousarray(array[...]).tobytes()
    del attrs["field_hashes"][name], attrs["content_hash"], attrs["seal_hash"]
    attrs["field_hashes"][former] = _hash(described + values)
    rounding = attrs["summary"].get("rounding_px", {})
    if name in rounding:
        rounding[former] = rounding.pop(name)
    content = {key: value for key, value in attrs.items() if key not in ("timings", "versions")}
    attrs["content_hash"] = _hash(_canonical(content))
    attrs["seal_hash"] = _hash(_canonical(attrs))
    group.attrs.put(attrs)


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _hash(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
