"""The options of a video, which `learn predict` and `bench estimate` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

Scale = Annotated[
    str | None, Option(help="A video's [mm/px]; unknown: forces up to a factor. Two cameras measure it.")
]
Tissue = Annotated[Path | None, Option(help="Picture, white on tissue. Default: found by motion.")]
Masks = Annotated[str, Option(help="Of the instruments: auto, none, or a folder of NNNNNN.png or mask.png.")]
Shrink = Annotated[int, Option(min=0, max=8, help="Shrink a video first; 0: to 320 columns.")]
Rate = Annotated[float, Option(min=0.0, help="Most frames per second of a video; 0: all.")]
Rest = Annotated[int, Option(min=0, help="Number of the frame in which the tissue is unloaded.")]
Pulse = Annotated[bool, Option(help="Subtract heartbeat and breathing from the motion.")]
Overlay = Annotated[bool, Option(help="Also NAME.force.mp4, the force over the video.")]

Right = Annotated[Path | None, Option(help="The same video by a second camera, to the right.")]
Calibration = Annotated[
    Path | None, Option(help="Of both cameras: OpenCV's K1, D1, K2, D2, R, T, Kalibr or others.")
]
MmPerUnit = Annotated[float, Option(min=1e-9, help="mm in one unit of the calibration's T.")]
