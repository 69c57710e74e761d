"""The options of a second camera, which `learn predict` and `bench estimate` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

Right = Annotated[Path | None, Option(help="The same video by a second camera, to the right.")]
Calibration = Annotated[
    Path | None, Option(help="Of both cameras: OpenCV's K1, D1, K2, D2, R, T, Kalibr or others.")
]
MmPerUnit = Annotated[float, Option(min=1e-9, help="mm in one unit of the calibration's T.")]
