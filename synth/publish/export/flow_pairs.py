"""Export to pairs of pictures with optical flow, in the two layouts that loaders of optical flow read.

MPI Sintel: D. J. Butler et al., "A naturalistic open source movie for optical flow evaluation", ECCV 2012.
KITTI 2015: M. Menze, A. Geiger, "Object scene flow for autonomous vehicles", CVPR 2015.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synth.arrays import Array, Map, Mask
from synth.dataset.index import group_by_side
from synth.dataset.store import Dataset, Sequence
from synth.publish.export.encoding import as_png

_UNKNOWN = np.float32(1e10)  # Middlebury's value of unknown flow in .flo; loaders treat above 1e9 as invalid
_TREES = {"train": ("training", "training"), "validation": ("validation",) * 2, "test": ("test", "testing")}
_HEAD = "kind,side,scene,flo,pair,sequence,first,second"


@dataclass(frozen=True)
class _Pair:
    """Two frames of a sequence, and the flow at the pixels of the first."""

    first: int
    second: int
    flow: Map  # (H, W, 2) px
    valid: Mask  # (H, W) pixels with a flow
    visible: Mask  # (H, W) whether their points are visible in the second frame


def write_pairs(dataset: Dataset, target: Path) -> None:
    """Writes pairs of frames as of MPI Sintel and KITTI 2015, a tree for each side of the split.

    `rest`: each frame but the first with the rest frame. `flow_next`: each frame with the next one, of
    datasets with the field `flow_next_all` (of all that is seen) or `flow_next` (of the tissue). In each, as
    torchvision reads them, `Sintel/training` (test, validation): `clean/SCENE/frame_NNNN.png`,
    `flow/SCENE/frame_NNNN.flo`, 1e10 where there is no flow, `occlusions` and `invalid`, 255 where a point is
    hidden in the second frame and where there is no flow; `KittiFlow/training` (testing, validation): pair K
    as `image_2/KKKKKK_10.png` and `_11.png`, `flow_occ/KKKKKK_10.png` of 16 bits (64 u + 2^15, 64 v + 2^15, 1
    where valid), so rounded to 1/64 px, and `flow_noc`, valid only where visible. `pairs.csv` lists the
    pairs, `README.md` states the conventions.
    """
    lines, numbers = [_HEAD], {"rest": 0, "flow_next": 0}
    for side, positions in group_by_side(dataset).items():
        for sequence in (dataset[position] for position in positions):
            pictures = [as_png(picture) for picture in sequence["rgb"][:]]
            for kind, pairs in (("rest", _from_rest(sequence)), ("flow_next", _to_next(sequence))):
                sintel, kitti = (target / kind / name for name in ("Sintel", "KittiFlow"))
                for pair in pairs:
                    scene, frame_number = f"{sequence.index:06d}", pair.first + 1
                    if kind == "rest":  # a scene of two frames: loaders pair neighbours
                        scene, frame_number = f"{sequence.index:06d}_{pair.second:04d}", 1
                    pair_pictures = pictures[pair.first], pictures[pair.second]
                    _write_sintel(sintel / _TREES[side][0], scene, frame_number, pair_pictures, pair)
                    _write_kitti(kitti / _TREES[side][1], f"{numbers[kind]:06d}", pair_pictures, pair)
                    row = kind, side, scene, f"frame_{frame_number:04d}.flo", numbers[kind], sequence.index
                    lines.append(",".join(map(str, (*row, pair.first, pair.second))))
                    numbers[kind] += 1
    (target / "pairs.csv").write_text("\n".join(lines) + "\n", "utf-8")
    (target / "README.md").write_text(_CONVENTIONS, "utf-8")


def _from_rest(sequence: Sequence) -> Iterator[_Pair]:
    """Each frame but the first with the rest frame."""
    tissue = sequence["tissue"][:] > 0
    for t in range(1, sequence.frames):
        flow, visible = sequence["flow"][t].astype(np.float32), sequence["visible"][t] > 0
        yield _Pair(0, t, flow, tissue & ~(sequence["tool"][0] > 0), visible)


def _to_next(sequence: Sequence) -> Iterator[_Pair]:
    """Each frame with the next one; none of a sequence without flow between them."""
    has_all = "flow_next_all" in sequence
    if not has_all and "flow_next" not in sequence:
        return
    tissue = sequence["tissue"][:] > 0
    for t in range(sequence.frames - 1):
        flow = sequence["flow_next_all" if has_all else "flow_next"][t].astype(np.float32)
        motion, seen_tissue = sequence["flow"][t], tissue & (sequence["visible"][t] > 0)
        carried = carry_forward(seen_tissue, motion) & ~(sequence["tool"][t] > 0)
        hidden = carry_forward(seen_tissue & ~(sequence["visible"][t + 1] > 0), motion) & carried
        height, width = carried.shape
        x, y = np.arange(width) + flow[..., 0], np.arange(height)[:, None] + flow[..., 1]
        inside = (x > -0.5) & (y > -0.5) & (x < width - 0.5) & (y < height - 0.5)
        valid = sequence["depth"][t] > 0 if has_all and "depth" in sequence else carried
        yield _Pair(t, t + 1, flow, np.asarray(valid, bool), np.asarray(inside & ~hidden, bool))


def carry_forward(rest: Mask, flow: Map) -> Mask:
    """A mask (H, W) of rest pixels in the frame to which the flow (H, W, 2) px leads, small gaps closed."""
    height, width = rest.shape
    rows, columns = np.nonzero(rest)
    x, y = (np.rint(positions).astype(int) for positions in (columns + flow[rest, 0], rows + flow[rest, 1]))
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    mask = np.zeros((height, width), np.uint8)
    mask[y[inside], x[inside]] = 1
    padded = cv2.copyMakeBorder(mask, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))[2:-2, 2:-2], bool)


def _write_sintel(
    root: Path, scene: str, frame_number: int, pictures: tuple[bytes, bytes], pair: _Pair
) -> None:
    for kind in ("clean", "flow", "occlusions", "invalid"):
        (root / kind / scene).mkdir(parents=True, exist_ok=True)
    for k, data in enumerate(pictures):
        (root / "clean" / scene / f"frame_{frame_number + k:04d}.png").write_bytes(data)
    head = b"PIEH" + np.array(pair.flow.shape[1::-1], "<i4").tobytes()  # Middlebury's format
    values = np.where(pair.valid[..., None], pair.flow, _UNKNOWN).astype("<f4").tobytes()
    name = f"frame_{frame_number:04d}"
    (root / "flow" / scene / f"{name}.flo").write_bytes(head + values)
    (root / "occlusions" / scene / f"{name}.png").write_bytes(as_png(pair.valid & ~pair.visible))
    (root / "invalid" / scene / f"{name}.png").write_bytes(as_png(~pair.valid))


def _write_kitti(root: Path, name: str, pictures: tuple[bytes, bytes], pair: _Pair) -> None:
    for kind in ("image_2", "flow_occ", "flow_noc"):
        (root / kind).mkdir(parents=True, exist_ok=True)
    for k, data in enumerate(pictures):
        (root / "image_2" / f"{name}_{10 + k}.png").write_bytes(data)
    for kind, valid in (("flow_occ", pair.valid), ("flow_noc", pair.valid & pair.visible)):
        (root / kind / f"{name}_10.png").write_bytes(_as_kitti(pair.flow, valid))


def _as_kitti(flow: Map, valid: Mask) -> bytes:
    levels = np.rint(64 * flow + 2**15).clip(0, 2**16 - 1) * valid[..., None]
    planes: Array = np.dstack([valid, levels[..., 1], levels[..., 0]]).astype(np.uint16)  # OpenCV stores BGR
    return bytes(cv2.imencode(".png", planes)[1].tobytes())


_CONVENTIONS = """\
# Pairs of pictures with their optical flow

| folder | pairs |
| --- | --- |
| `rest` | frame 0, at rest, and each later frame: long-range motion of tissue |
| `flow_next` | each frame and the next one; there only if the dataset has `flow_next_all` or `flow_next` |

Each holds the same pairs twice, in the layouts of MPI Sintel (`Sintel/training`, `validation`, `test`) and of
KITTI 2015 (`KittiFlow/training`, `validation`, `testing`): the sides of the dataset's split. No anatomy is on
two sides. If the dataset has too few anatomies to split, all is in `training`.

    torchvision.datasets.Sintel("THIS_FOLDER/flow_next", split="train", pass_name="clean")
    torchvision.datasets.KittiFlow("THIS_FOLDER/flow_next", split="train")

- **Flow** (u, v) in pixels at the pixel centres of the *first* picture: the point at column x and row y is at
  (x + u, y + v) in the second one. x to the right, y down, (0, 0) is the centre of the top left pixel. It is
  the motion of material points, from geometry, in the recorded (distorted) pictures.
- **Where there is no flow** a `.flo` is 1e10 (Middlebury's "unknown": leave out what is above 1e9), `invalid`
  is 255, and the third channel of KITTI's flow is 0. In `rest` that is whatever is not tissue, or hidden by
  an instrument in the rest frame. In `flow_next` it is where nothing is hit if the dataset has
  `flow_next_all` (instruments and the rim have their own motion then), else whatever is not tissue.
- **Occluded** (`occlusions` 255, not in `flow_noc`): the point has a flow, but can't be seen in the second
  picture: it is behind an instrument or a fold, or outside of the picture. Highlights don't occlude. In
  `flow_next` this is known of tissue that was seen at rest, to a pixel; other points count as visible.
- **KITTI's flow** is 16-bit PNG, (value - 2^15) / 64: rounded to 1/64 px.
- **pairs.csv** has a row for each pair: `kind` (the folder), `side` of the split, `scene` and `flo` (the
  `.flo` in `Sintel/*/flow/SCENE/`), `pair` (the number in KITTI's layout), `sequence`, and the frames `first`
  and `second` of it in the dataset, counted from 0.
"""
