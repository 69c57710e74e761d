"""Export to pairs of pictures with optical flow, in the two layouts that loaders of optical flow read.

MPI Sintel: D. J. Butler et al., "A naturalistic open source movie for optical flow evaluation", ECCV 2012.
KITTI 2015: M. Menze, A. Geiger, "Object scene flow for autonomous vehicles", CVPR 2015.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from synth.arrays import Map, Mask
from synth.dataset.store import Dataset
from synth.publish.export.encoding import as_png

_UNKNOWN = np.float32(1e10)  # Middlebury's value of unknown flow in .flo; loaders treat above 1e9 as invalid


def write_pairs(dataset: Dataset, target: Path) -> None:
    """Writes each frame but the first as a pair with the rest frame, once in each layout.

    `sintel/training`: `clean/NNNNNN_TTTT/frame_0001.png` (rest) and `frame_0002.png` (frame T of sequence N),
    `flow/NNNNNN_TTTT/frame_0001.flo`, 1e10 where there is no tissue, `occlusions/NNNNNN_TTTT/frame_0001.png`,
    255 where tissue is hidden in frame T, and `invalid/...`, 255 where there is no tissue.

    `kitti/training`: pair K as `image_2/KKKKKK_10.png` (rest) and `KKKKKK_11.png`; `flow_occ/KKKKKK_10.png`
    of 16 bits (64 u + 2^15, 64 v + 2^15, 1 where valid), so rounded to 1/64 px, and `flow_noc`, valid only
    where visible. `kitti/pairs.csv` has the sequence and the frame of each pair.
    """
    lines = ["pair,sequence,frame"]
    for sequence in dataset:
        pictures = [as_png(picture) for picture in sequence["rgb"][:]]
        tissue = sequence["tissue"][:] > 0
        for t in range(1, sequence.frames):
            flow, visible = sequence["flow"][t].astype(np.float32), sequence["visible"][t] > 0
            both = pictures[0], pictures[t]
            _write_sintel(
                target / "sintel/training", f"{sequence.index:06d}_{t:04d}", both, flow, tissue, visible
            )
            _write_kitti(target / "kitti/training", f"{len(lines) - 1:06d}", both, flow, tissue, visible)
            lines.append(f"{len(lines) - 1},{sequence.index},{t}")
    (target / "kitti/pairs.csv").write_text("\n".join(lines) + "\n", "utf-8")


def _write_sintel(
    root: Path, name: str, both: tuple[bytes, bytes], flow: Map, tissue: Mask, visible: Mask
) -> None:
    for kind in ("clean", "flow", "occlusions", "invalid"):
        (root / kind / name).mkdir(parents=True)
    for k, data in enumerate(both, 1):
        (root / "clean" / name / f"frame_{k:04d}.png").write_bytes(data)
    head = b"PIEH" + np.array(flow.shape[1::-1], "<i4").tobytes()  # Middlebury's format
    values = np.where(tissue[..., None], flow, _UNKNOWN).astype("<f4").tobytes()
    (root / "flow" / name / "frame_0001.flo").write_bytes(head + values)
    (root / "occlusions" / name / "frame_0001.png").write_bytes(as_png(tissue & ~visible))
    (root / "invalid" / name / "frame_0001.png").write_bytes(as_png(~tissue))


def _write_kitti(
    root: Path, name: str, both: tuple[bytes, bytes], flow: Map, tissue: Mask, visible: Mask
) -> None:
    for kind in ("image_2", "flow_occ", "flow_noc"):
        (root / kind).mkdir(parents=True, exist_ok=True)
    for k, data in enumerate(both):
        (root / "image_2" / f"{name}_{10 + k}.png").write_bytes(data)
    for kind, valid in (("flow_occ", tissue), ("flow_noc", tissue & visible)):
        levels = np.rint(64 * flow + 2**15).clip(0, 2**16 - 1) * valid[..., None]
        planes = np.dstack([valid, levels[..., 1], levels[..., 0]]).astype(np.uint16)  # OpenCV stores BGR
        (root / kind / f"{name}_10.png").write_bytes(cv2.imencode(".png", planes)[1].tobytes())
