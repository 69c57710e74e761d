"""What a job's sensor has to be to have a given camera's noise."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from evidence.measuring import measuring
from evidence.render import photon_transfer
from synth.errors import UserError


@measuring(
    "flats darks",
    text=lambda found: (
        f"sensor.full_well={found['full_well']:.0f} sensor.read_noise={found['read_noise']:.2f}"
    ),
)
def camera_noise(
    flats: Annotated[
        Path, typer.Argument(help="Folder of raw pictures of an even surface, two of each exposure.")
    ],
    darks: Annotated[Path, typer.Argument(help="Folder of raw pictures with the lens capped, two or more.")],
    full_scale: Annotated[
        float | None, typer.Option(help="Largest grey level; by default what the files can hold.")
    ] = None,
) -> dict[str, Any]:
    """Full well and read noise of a camera from its flat and dark frames, as settings of a job."""
    bright, scale = photon_transfer.load(flats)
    dark, other = photon_transfer.load(darks)
    if scale != other:
        raise UserError(f"{flats} and {darks}: pictures of different depth")
    return asdict(photon_transfer.fit(bright, dark, full_scale or scale))
