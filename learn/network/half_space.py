"""Physics without learning, as a network's first layer: the tractions on a half-space that move it as seen.

Tractions are uniform over the cells of a coarse grid (at most 32² of them); what they move is the exact
solution of Boussinesq and Cerruti (Johnson, Contact Mechanics, 1985, chapter 3), integrated over the cell in
closed form. Its inverse is Tikhonov's, only where tissue is seen: a picture that ends is not tissue that
stands still, and taking it for that errs by half of the force.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from torch import Tensor, nn

Floats = NDArray[np.float64]

POISSON = 0.45
CELLS = 32
"""Along the coarse grid's edge, at most."""
SMOOTH = 1 / 36
"""Of the grid's width (1 mm of 36): the wave number whose inverse this is, is let through by half."""
TERMS = 18
"""Products with the compliance a frame; what it says is then within 1% of Tikhonov's, of noise too."""


_HELD = ("rows", "columns", "rows_back", "columns_back", "table")


class HalfSpace(nn.Module):
    """(B, C, N, N) displacement and (B, 1, N, N) mask 0/1 → (B, C, N, N) traction, 0 outside the mask.

    C = 2 (across the view) or 3. It is linear, nothing in it is learnt, and `gain` alone, which travels with
    the weights, says what its units are: without it displacement is in grid widths and traction in kPa, of
    tissue of E = 1 kPa.
    """

    gain: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("gain", torch.tensor(1.0))

    def set_units(self, displacement_mm: float, extent_mm: float, traction: float) -> None:
        """`displacement_mm` and `traction` [mN/mm²]: what 1 stands for; `extent_mm`: the grid's width."""
        self.gain.fill_(displacement_mm / (extent_mm * traction))

    def hold(self, size: int, parts: int) -> None:
        """Keeps what one grid needs with the module: an exported graph then has it once, not once a term.

        `size`: N; `parts`: C. To be done to a copy: its weights hold it then, for ONNX knows those by name.
        """
        for name, value in zip(_HELD, _compliance(size // _fold(size), parts), strict=True):
            self.register_buffer(name, value)

    def forward(self, moved: Tensor, mask: Tensor) -> Tensor:
        with torch.autocast(moved.device.type, enabled=False):
            shift, inside = moved.float(), mask.float()
            size = int(shift.shape[-1])  # a trace has tensors for sizes
            fold = _fold(size)
            seen = F.avg_pool2d(inside, fold)
            mean = F.avg_pool2d(shift * inside, fold) / seen.clamp_min(1e-6)
            held = dict(self.named_buffers())
            basis = [held[name] for name in _HELD if name in held]
            basis = basis or [one.to(shift) for one in _compliance(size // fold, int(shift.shape[1]))]
            said = _inverse(mean * (size // fold) * self.gain, seen.sqrt(), basis)
            said = F.interpolate(said, scale_factor=float(fold), mode="bilinear", align_corners=False)
            return said * inside


def _fold(size: int) -> int:
    """Cells of a grid along an edge of a coarse one."""
    return next(k for k in range(1, size + 1) if size % k == 0 and size // k <= CELLS)


def _inverse(moved: Tensor, root: Tensor, basis: Sequence[Tensor]) -> Tensor:
    """Tractions (B, C, M, M) that explain displacements in cells, both weighed by `root` (B, 1, M, M) twice.

    Tikhonov's S / (S² + λ) with S = root G root, as a Chebyshev polynomial of S: the compliance G is
    symmetric (Betti), so its spectrum is an interval, and no system is solved.
    """
    top, terms = _filter(int(moved.shape[-1]), int(moved.shape[1]))
    last, now = torch.zeros_like(moved), root * moved
    said = terms[0] * now
    for k, term in enumerate(terms[1:]):
        step = root * _moved(root * now, basis) * (2 / top) - now
        last, now = now, (2 * step - last if k else step)
        said = said + term * now
    return root * said


def _moved(traction: Tensor, basis: Sequence[Tensor]) -> Tensor:
    """What tractions (B, C, M, M) move, in cells: a convolution by products with cosines and sines, which,
    unlike a Fourier transform, every program that reads ONNX knows."""
    rows, columns, rows_back, columns_back, table = basis
    parts, half = int(traction.shape[1]), int(table.shape[-1])
    wave = (rows @ traction @ columns).reshape(-1, parts, 2, half, 2, half).transpose(3, 4)
    wave = (table * wave.reshape(-1, 1, 4 * parts, half, half)).sum(2)
    wave = wave.reshape(-1, parts, 2, 2, half, half).transpose(3, 4)
    return rows_back @ wave.reshape(-1, parts, 2 * half, 2 * half) @ columns_back


@functools.lru_cache(maxsize=8)
def _compliance(cells: int, parts: int) -> tuple[Tensor, ...]:
    """`_HELD`: cosines and sines, (2K, M) for rows and (M, 2K) for columns; weighed for the way back, (M, 2K)
    and (2K, M); and (4C, 4C, K, K) from those of tractions to those of what they move."""
    # Twice the cells: what is moved at one edge must not come in again at the other.
    k = np.arange(cells + 1) * math.pi / cells
    at, away = np.outer(k, np.arange(cells)), np.outer(k, np.arange(1 - cells, cells))
    waves = np.stack([np.cos(at), np.sin(at)])
    weight = np.where((k == 0) | (k == k[-1]), 1.0, 2.0)[:, None] / (2 * cells)
    trig, turn = np.stack([np.cos(away), np.sin(away)]), np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]]])
    spectrum = np.einsum("dcyx,pky,qlx->dcpqkl", kernel(cells, parts), trig, trig, optimize=True)
    table = np.einsum("dcpqkl,prs,qtu->drtcsukl", spectrum, turn, turn, optimize=True)
    rows, back = waves.reshape(-1, cells), (waves * weight).reshape(-1, cells)
    found = rows, rows.T, back.T, back, table.reshape(4 * parts, 4 * parts, len(k), len(k))
    return tuple(torch.from_numpy(np.array(one, np.float32, order="C")) for one in found)


@functools.lru_cache(maxsize=8)
def _filter(cells: int, parts: int) -> tuple[float, list[float]]:
    """A bound of the compliance's eigenvalues, and the polynomial's coefficients up to there."""
    # No row adds up to more than that of a cell in the middle.
    near = slice(cells // 2 - 1, cells // 2 + cells)
    top = float(np.abs(kernel(cells, parts)[..., near, near]).sum(axis=(1, 2, 3)).max())
    # At the wave number k a shear traction across it moves 2 (1 + ν) / (E k).
    damp = (2 * (1 + POISSON) * SMOOTH * cells) ** 2

    x = chebyshev.chebpts1(TERMS + 1)
    stiff = top * (x + 1) / 2
    found = chebyshev.chebfit(x, stiff / (stiff**2 + damp), TERMS)
    return top, [float(c) for c in found]


def kernel(cells: int, parts: int) -> Floats:
    """What traction 1 kPa on a cell moves, (C, C, 2M - 1, 2M - 1): mean over the cell so far away, in cells.

    First index: of the displacement, second: of the traction, then y, x; E = 1 kPa. z points into the
    half-space.
    """
    points = (np.arange(4) - 1.5) / 4
    return np.asarray(np.mean([_at(cells, parts, y, x) for y in points for x in points], axis=0))


def _at(cells: int, parts: int, y: float, x: float) -> Floats:
    """`kernel` at a point of the cells, y, x from their middle: integrals over a square, by its corners."""
    ends = np.arange(-cells, cells) + 0.5
    b, a = np.meshgrid(ends + y, ends + x, indexing="ij")
    r = np.hypot(a, b)

    def over(corner: Floats) -> Floats:
        return np.diff(np.diff(corner, axis=0), axis=1)

    xx, yy, xy = over(b * np.log(a + r)), over(a * np.log(b + r)), over(-r)
    out: Floats = np.zeros((3, 3, *xx.shape))
    out[:2, :2] = POISSON * np.array([[xx, xy], [xy, yy]])
    for k in range(3):
        out[k, k] += (1 - POISSON) * (xx + yy)
    tilt = (0.5 - POISSON) * np.stack(
        [over(b * np.log(r) + a * np.arctan(b / a)), over(a * np.log(r) + b * np.arctan(a / b))]
    )
    out[2, :2], out[:2, 2] = tilt, -tilt
    out *= (1 + POISSON) / math.pi
    return np.asarray(out[:parts, :parts])
