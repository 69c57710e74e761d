"""Sequences of PLUS/IGSIO as recorders of instruments write them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

POSE = "1 0 0 {} 0 1 0 2 0 0 1 3 0 0 0 1"


def write_igs(
    path: Path,
    times: NDArray[np.float64],
    force: NDArray[np.float64],
    film: str,
    invalid: Mapping[int, str] | None = None,
    *,
    pixels: NDArray[np.uint8] | None = None,
    local: bool = True,
) -> Path:
    """A sequence with the times (T,) s, forces (T, 3) and three torques of every frame, and a pose that moves
    by 1 mm along x a frame; `film`: its VideoFile; `invalid`: what has the status INVALID in a frame;
    `pixels`: (T, H, W), without them `film` has the pictures; `local`: whether ElementDataFile is written."""
    size = "1 1" if pixels is None else f"{pixels.shape[2]} {pixels.shape[1]}"
    head = {
        "ObjectType": "Image",
        "NDims": 3,
        "BinaryData": True,
        "BinaryDataByteOrderMSB": False,
        "CompressedData": False,
        "DimSize": f"{size} {len(times)}",
        "ElementSpacing": "1 1 1",
        "ElementType": "MET_NONE" if pixels is None else "MET_UCHAR",
        "Offset": "0 0 0",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "UltrasoundImageOrientation": "MF",
        "RecordingStartUnixTime": "1787000000.598",
        **({"VideoFile": film} if film else {}),
    }
    for k, (t, f) in enumerate(zip(times, force, strict=True)):
        values = {
            "TipToWorldTransform": POSE.format(k),
            "Force": " ".join(f"{x:.6f}" for x in f) + " 0.03 -0.2 3.4",
            "Timestamp": f"{t:.6f}",
        }
        status = {"TipToWorldTransform": "OK", "Force": "OK", "Image": "INVALID" if pixels is None else "OK"}
        if invalid and k in invalid:
            status[invalid[k]] = "INVALID"
        frame = {**values, **{f"{name}Status": word for name, word in status.items()}}
        head |= {f"Seq_Frame{k:06d}_{name}": value for name, value in frame.items()}
    if local:
        head["ElementDataFile"] = "LOCAL"
    text = "".join(f"{name} = {value}\n" for name, value in head.items())
    path.write_bytes(text.encode() + (b"" if pixels is None else pixels.tobytes()))
    return path
