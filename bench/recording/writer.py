"""Writing a recording's folder: the files that `bench.recording.folder` reads."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from synth.errors import UserError

Floats = NDArray[np.float64]


@contextmanager
def whole(folder: Path) -> Iterator[Path]:
    """A folder to fill, which gets its name when the block ends well and is gone when it doesn't.

    Raises:
        UserError: it exists already.
    """
    if folder.exists():
        raise UserError(f"{folder}: exists already")
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield part
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    part.rename(folder)


def frames(folder: Path, time_s: Floats) -> None:
    """Writes frames.csv: the time of every frame, (T,) s."""
    _csv(folder / "frames.csv", "frame,t_s", "%d,%.6f", np.column_stack([np.arange(len(time_s)), time_s]))


def force(folder: Path, time_s: Floats, newtons: Floats) -> None:
    """Writes force.csv: the sensor's times (N,) s and forces (N, 3) N."""
    columns = np.column_stack([time_s, newtons])
    _csv(folder / "force.csv", "t_s,fx_n,fy_n,fz_n", "%.6f,%.9f,%.9f,%.9f", columns)


def tip(folder: Path, places: Floats) -> None:
    """Writes tip.csv: times and places of the instrument's tip, (N, 4) s, mm, mm, mm."""
    _csv(folder / "tip.csv", "t_s,x_mm,y_mm,z_mm", "%.6f,%.6f,%.6f,%.6f", places)


def about(folder: Path, said: Mapping[str, object]) -> None:
    """Writes meta.yaml."""
    with (folder / "meta.yaml").open("w", encoding="utf-8") as file:
        YAML().dump(dict(said), file)


def _csv(path: Path, head: str, line: str, rows: Floats) -> None:
    np.savetxt(path, rows, fmt=line, header=head, comments="")
