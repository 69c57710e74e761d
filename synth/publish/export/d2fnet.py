"""Export for the training code of the published method (D2FNet)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError

# The published loader drops nodes right of this pixel, and assumes that all files have the same nodes.
_LARGEST_X = 1400.0
_NODES = 20_000


def write_npz(dataset: Dataset, target: Path) -> None:
    """Writes `run_NNNNNN/brain_surface_NNNNNN_auto_projected_NNNNNN_2d.npz` for each sequence.

    Arrays as in github.com/D3MIA/D2FNet, d2fnet/dataset.py: `disp2d` (T, N, 2) mm, `force_mag` (T, N) N,
    `projected_pixels` (T, N, 2) px, with the same N in every file. Unlike there, displacement is in the plane
    of the picture, and `force_mag` is their "intensity" (peak = total force) from the true traction, as
    stated in the export's README.txt. Added are `times` (T,) s, `visible` (T, N), `depth` (T, N) mm if it is
    stored, and `..._meta.json` with the sequence's attributes.
    """
    count = min(_NODES, *(int(sequence["tissue"][:].sum()) for sequence in dataset))
    if not count:
        raise UserError(f"{dataset.root}: a sequence shows no tissue")
    for sequence in dataset:
        name = f"{sequence.index:06d}"
        (target / f"run_{name}").mkdir()
        path = target / f"run_{name}" / f"brain_surface_{name}_auto_projected_{name}_2d.npz"
        np.savez_compressed(path, times=sequence["time"][:], **_arrays(sequence, count))
        path.with_name(path.stem + "_meta.json").write_text(json.dumps(sequence.attrs, indent=1), "utf-8")
    (target / "README.txt").write_text(_NOTE, "utf-8")


def _arrays(sequence: Sequence, count: int) -> dict[str, Any]:
    """Arrays over time of `count` points of the tissue, by name."""
    tissue = np.argwhere(sequence["tissue"][:])
    rows, columns = tissue[np.linspace(0, len(tissue) - 1, count).round().astype(int)].T
    scale = float(sequence.attrs["scale_mm_per_px"])
    shrink = min(1.0, _LARGEST_X / sequence.size[1])
    force = np.linalg.norm(sequence["force"][:], axis=1)
    moved = np.empty((sequence.frames, count, 2), np.float32)
    intensity = np.zeros((sequence.frames, count), np.float32)
    pixels, depth = np.empty_like(moved), np.zeros_like(intensity)
    visible = np.zeros(intensity.shape, bool)
    rest = np.stack([columns, rows], axis=-1)
    for t in range(sequence.frames):
        flow = sequence["flow"][t][rows, columns]
        size = np.linalg.norm(sequence["traction"][t], axis=-1)
        moved[t] = scale * flow
        pixels[t] = shrink * (rest + flow)
        visible[t] = sequence["visible"][t][rows, columns]
        if size.max() > 0:
            intensity[t] = size[rows, columns] / size.max() * force[t] / 1000
        if "depth" in sequence:
            x, y = (rest + flow).astype(np.float32).T
            depth[t] = cv2.remap(sequence["depth"][t], x, y, cv2.INTER_NEAREST)[:, 0]
    found = {"disp2d": moved, "force_mag": intensity, "projected_pixels": pixels, "visible": visible}
    return found | ({"depth": depth} if "depth" in sequence else {})


_NOTE = """\
Layout of github.com/D3MIA/D2FNet: disp2d (T, N, 2) mm, force_mag (T, N) N, projected_pixels (T, N, 2) px.
disp2d is the motion in the plane of the picture times the scale, not world x and y.
force_mag is the "intensity" map, its peak scaled to the total force; the true traction is in the Zarr stores.
"""
