"""The network's isotropic grid in millimetres; for training and prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from synth.arrays import Map, Mask
from synth.errors import UserError, as_positive
from synth.job.types import MembraneState, Positive

CHANNELS = ("dx", "dy", "magnitude", "mask", "divergence")
SMOOTHING_MM = (
    0.5  # standard deviation of the Gaussian under the derivative; in mm, so that resolutions agree
)
HALF_SURE_MM = 0.04  # deviation of depth motion that force estimates tolerate; its confidence is a half


@dataclass(frozen=True)
class Grid:
    """N×N cells over a square of the picture that is `extent_mm` wide."""

    size: int
    extent_mm: float = 36.0

    @property
    def pitch_mm(self) -> float:
        return self.extent_mm / self.size


@dataclass(frozen=True)
class Scales:
    """99.9th percentiles of the training data, by which input and target are divided; and the target's rms.

    dx, dy and dz share one scale: else the estimate would depend on how the camera is turned.
    """

    displacement_mm: Positive
    divergence: Positive
    target: Positive  # force density per unit stiffness [mN/mm² at E = 1 kPa]
    force: Positive  # total force per unit stiffness [mN at E = 1 kPa]
    spread: Positive  # root mean square of the target over tissue cells and components, unit of `target`


def centre(tissue: Mask) -> tuple[float, float]:
    """Centroid of the tissue mask as (x, y) px. `tissue`: (H, W) bool. Raises UserError if it is empty."""
    rows, cols = np.nonzero(tissue)
    if rows.size == 0:
        raise UserError("the tissue mask is empty")
    return float(cols.mean()), float(rows.mean())


def check_scale(scale_mm_per_px: float) -> float:
    """The scale of a picture. UserError if it isn't positive, or is above 100, as cost grows with it."""
    return as_positive("scale [mm/px]", scale_mm_per_px, largest=100)


class GridView:
    """The grid on the pictures of one video: its tissue, and the resampling of arrays of pixels to cells.

    Pixels are weighted by hat functions as wide as the coarser of pixel and cell, by two sparse matrices.
    """

    def __init__(
        self, tissue: Mask, scale_mm_per_px: float, grid: Grid, centre_px: tuple[float, float] | None = None
    ) -> None:
        """`tissue`: (H, W); `centre_px`: (x, y) of the grid's centre; None: the tissue's centroid. UserError
        for another shape, an invalid scale, or a grid without tissue."""
        if tissue.ndim != 2:
            raise UserError(f"tissue mask: expected (H, W), got {tissue.shape}")
        self.tissue, self.grid, self.shape = tissue.astype(bool), grid, (tissue.shape[0], tissue.shape[1])
        self.scale_mm_per_px = check_scale(scale_mm_per_px)
        self.centre_px, self._centred_on = centre_px or centre(self.tissue), centre_px
        self._cols, self._rows = (
            _hats(self.shape[1 - axis], self.centre_px[axis], self.scale_mm_per_px, grid) for axis in (0, 1)
        )
        self._share = self._each(self.tissue, self._rows, self._cols)
        full = float(self._each(np.ones(self.shape), self._rows, self._cols).max(initial=0.0))
        self.mask = (self._share / (full or 1.0) > 0.5).astype(np.float32)
        """(N, N) 1 where more than half of a cell is tissue, else 0."""
        if not self.mask.any():
            raise UserError(f"at {scale_mm_per_px:g} mm/px the tissue covers no cell of the network's grid")

    def mean(self, values: NDArray[np.floating]) -> Map:
        """Mean (..., N, N) over the tissue in each cell of values (..., H, W); 0 where there is none."""
        over = self._each(values * self.tissue.astype(np.float32), self._rows, self._cols)
        is_covered = self._share > 1e-6
        return np.where(is_covered, over / np.where(is_covered, self._share, 1.0), 0.0).astype(np.float32)

    def sum(self, values: NDArray[np.floating]) -> Map:
        """Totals (..., N, N) of amounts per pixel (..., H, W), with the same sum inside the grid."""
        return self._each(values, _partition(self._rows), _partition(self._cols)).astype(np.float32)

    def to_image(self, values: NDArray[np.floating]) -> Map:
        """The function of this name."""
        return to_image(values, self.shape, self.centre_px, self.scale_mm_per_px, self.grid.pitch_mm)

    def matches(self, tissue: Mask, scale_mm_per_px: float, centre_px: tuple[float, float] | None) -> bool:
        same = (centre_px, float(scale_mm_per_px)) == (self._centred_on, self.scale_mm_per_px)
        return same and np.array_equal(self.tissue, tissue)

    def _each(
        self, values: NDArray[np.floating | np.bool_], rows: sparse.csr_array, cols: sparse.csr_array
    ) -> NDArray[np.floating]:
        """Weighted sums of pixels, (..., H, W) → (..., N, N)."""
        flat, n = values.reshape(-1, *self.shape), self.grid.size
        half = [rows @ np.ascontiguousarray(plane, np.float32) for plane in flat]
        cells = [(cols @ np.ascontiguousarray(plane.T)).T for plane in half]
        return np.stack(cells).reshape(*values.shape[:-2], n, n)


def to_image(
    values: NDArray[np.floating],
    shape: tuple[int, int],
    centre_px: Sequence[float],
    scale_mm_per_px: float,
    pitch_mm: float,
) -> Map:
    """Values (N, N) of a grid's cells at the pixels of a picture of `shape` (H, W), bilinear, 0 outside the
    grid; `centre_px`: x, y of the grid's centre in it."""
    ratio, middle = scale_mm_per_px / pitch_mm, (len(values) - 1) / 2
    axes = [(np.arange(n) - origin) * ratio for n, origin in zip(shape, centre_px[::-1], strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"))
    sampled = ndimage.map_coordinates(values, cells + middle, order=1, mode="nearest")
    return np.where((np.abs(cells) <= middle + 0.5).all(axis=0), sampled, 0).astype(np.float32)


def settle(amount: Map, mask: Map) -> Map:
    """Moves amounts outside the mask to the nearest cell inside, which preserves the total.

    `amount`: (C, N, N) per cell; `mask`: (N, N) 0/1, not empty. Returns (C, N, N), 0 outside the mask.
    """
    inside = mask > 0
    out = np.where(inside, amount, np.float32(0))
    rows, cols = np.nonzero(~inside & (amount != 0).any(0))
    if rows.size:
        nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        targets = nearest[0][rows, cols], nearest[1][rows, cols]
        for plane, amounts in zip(out, amount[:, rows, cols], strict=True):
            np.add.at(plane, targets, amounts)
    return out


def _hats(length: int, centre_px: float, scale: float, grid: Grid) -> sparse.csr_array:
    """(N, length) hat weights between grid nodes and pixel centres."""
    pixels = (np.arange(length) - centre_px) * scale
    nodes = (np.arange(grid.size) - (grid.size - 1) / 2) * grid.pitch_mm
    width = max(grid.pitch_mm, scale)
    reach = int(np.ceil(width / grid.pitch_mm)) + 1
    nearest = np.rint((pixels - nodes[0]) / grid.pitch_mm).astype(int)
    node = nearest[None, :] + np.arange(-reach, reach + 1)[:, None]
    pixel = np.broadcast_to(np.arange(length), node.shape)
    weight = 1 - np.abs((nodes[0] + node * grid.pitch_mm) - pixels[pixel]) / width
    keep = (weight > 0) & (node >= 0) & (node < grid.size)
    return sparse.csr_array(
        (weight[keep].astype(np.float32), (node[keep], pixel[keep])), shape=(grid.size, length)
    )


def _partition(hats: sparse.csr_array) -> sparse.csr_array:
    """The same weights, normalised to a sum of one for every pixel, which preserves totals."""
    total = np.asarray(hats.sum(axis=0)).ravel()
    scale = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
    return (hats @ sparse.diags_array(scale.astype(np.float32))).tocsr()


def membrane_code(state: MembraneState) -> float:
    """Value of the membrane channel: -1 stripped, 0 unknown, 1 intact."""
    return get_args(MembraneState).index(state) - 1.0


def certainty(deviation_mm: Map) -> Map:
    """Confidence in 0..1 of motion of deviation (..., 3) mm across and along the optical axis, (2, ...)."""
    across = np.sqrt(np.square(deviation_mm[..., :2]).mean(axis=-1))
    spread = np.stack([across, deviation_mm[..., 2]])
    return np.asarray(1 / (1 + np.square(spread / HALF_SURE_MM)), np.float32)
