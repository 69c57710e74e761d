"""Change of disparity since rest, from the pictures of both cameras and the flow of the left one.

The unknown is the change d(x) of disparity of the tissue at the left rest pixel x. With w the left flow and D
the rest disparity, this tissue appears at x and x + w in the left pictures, and at x - (D, 0) and
x + w - (D + d, 0) in the right ones. The two brightness residuals, left rest to now and right rest to now,
depend on w in the same way, so that their difference

    q(x, d) = [R_t(x + w - (D + d, 0)) - R_0(x - (D, 0))] - [L_t(x + w) - L_0(x)]

is to first order free of w, of its errors, and of changes of light that both cameras see. Highlights, which
differ between them, are masked and have low weight. The method minimises

    E(d) = sum_x  m(x) rho( |(q, d_x q, d_y q) / s|^2 )  +  sum_cells |d2 d|^2 / k^2 ,

for contrast-normalised pictures, with s the robust deviation of the residuals, rho that of Student's
distribution with 4 degrees of freedom, m the mask (visible in all four pictures), d2 the second differences
(a thin plate: G. Wahba, Spline Models for Observational Data, 1990), and k their standard deviation, which in
mm is the same for every rig. k grows with the gradient of w, because contacts bend the surface where they
strain it. d is defined on cells of a fortieth of the width: depth motion under a contact is no finer, and the
system is small. The solver is Gauss-Newton on warped pictures with renewed weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from synth.arrays import Array, Floats, Map
from synth.flow import kernels
from synth.system.jit import vectorised

_FREEDOM = np.float32(4.0)  # degrees of freedom of Student's distribution
_CHANNELS = np.float32(3.0)
_WINDOW = (5, 5)  # cells over which precision is averaged
_CORRELATED_PX = 40.0  # number of pixels over which errors of samples are correlated
_MEDIAN = 0.4549  # median of the square of a standard normal variable
_ONE, _EIGHT, _TWELFTH, _HALF = np.float32(1), np.float32(8), np.float32(1 / 12), np.float32(0.5)


class DepthMotion:
    """Constants of the prior and the solver, chosen by hand on renders (docs/results/flow/stereo)."""

    columns: int = 40  # cells across the picture
    bend_mm: float = 0.004  # k of unstrained tissue: second differences of depth motion between cells
    strained_mm: float = 2.0  # added to k per px/px of the gradient of the flow
    cold_steps: int = 4  # linearisations from zero
    warm_steps: int = 2  # linearisations from the frame before


@dataclass(frozen=True)
class StereoPictures:
    """Four contrast-normalised, rectified pictures and their masks, all (H, W)."""

    left_rest: Map
    right_rest: Map  # warped to the left rest pixels
    rest_usable: Map  # in both rest pictures
    left: Map
    right: Map
    left_usable: Map
    right_usable: Map


@dataclass(frozen=True)
class Change:
    """Change of disparity since rest on pixels (H, W), with its information on cells (h, w)."""

    px: Map  # (H, W) change of disparity
    precision: Map  # (h, w) 1/px^2, information of the pictures; 0 where nothing is visible
    pull: Map  # (h, w) 1/px, precision times the change that the pictures alone would give
    stiffness: Map  # (h, w) 1/px^2: 1 / k^2
    misfit: Map  # (h, w) mean square of the residuals over their variance; 1 where nothing is visible
    visible: Map  # (H, W) 0 or 1: in all four pictures
    lag: float = 0.0  # share of the left motion that the right picture lacks; 0 for synchronous cameras

    @property
    def deviation(self) -> Map:
        """(h, w) px, posterior standard deviation of the plate, which ignores correlated errors."""
        precision = cv2.blur(self.precision, _WINDOW, borderType=cv2.BORDER_REPLICATE) + 1e-3
        return np.asarray(1 / np.sqrt(8 * np.sqrt(precision * self.stiffness)), np.float32)


class Solver:
    """Solver for pictures of one size."""

    def __init__(self, size: tuple[int, int]) -> None:
        """`size`: (height, width) [px]."""
        height, width = size
        self.cell = max(1, round(width / DepthMotion.columns))
        self.shape = (-(-height // self.cell), -(-width // self.cell))
        self._bends = second_differences(self.shape)

    def solve(
        self, pictures: StereoPictures, flow: Map, disparity: Map, px_per_mm: float, initial: Map | None
    ) -> Change:
        """Solves for the change of disparity since rest.

        Args:
            pictures: rest and now.
            flow, disparity: (2, H, W) px, of the left camera, and (H, W) px at rest, finite everywhere.
            px_per_mm: magnitude of the change of disparity of a point that moves 1 mm along the optical axis.
            initial: (H, W) px, the solution of the previous frame; None: zero.
        """
        warped, visible = np.empty_like(disparity), np.empty_like(disparity)
        kernels.warp_into(pictures.left, pictures.left_usable, flow, warped, visible)
        left_now, left_rest = _stack_derivatives(warped), _stack_derivatives(pictures.left_rest)
        right_rest = _stack_derivatives(pictures.right_rest)
        left_sum, target = left_now + left_rest, left_now - left_rest + right_rest
        mask = pictures.rest_usable * visible
        stiffness, prior = self._prior(flow, px_per_mm)
        change = np.zeros_like(disparity) if initial is None else initial
        sums = np.zeros((4, *self.shape), np.float64)
        right_flow = np.empty_like(flow)
        right_flow[1] = flow[1]
        for _ in range(DepthMotion.cold_steps if initial is None else DepthMotion.warm_steps):
            right_flow[0] = flow[0] - disparity - change
            kernels.warp_into(pictures.right, pictures.right_usable, right_flow, warped, visible)
            overlap = mask * visible
            right_now = _stack_derivatives(warped)
            noise = _noise(right_now - target, overlap)
            sums[:] = 0
            gather(right_now, right_rest, left_sum, target, overlap, change, noise, self.cell, sums)
            np.maximum(sums[0], 0, out=sums[0])
            change = interpolate_cells(self._solve_cells(prior, sums[0], sums[1]), self.cell, disparity.shape)
        misfit = np.where(sums[3] > 0, sums[2] / np.maximum(sums[3], 1), 1)
        lag = _lag(right_now[0] - target[0], right_now[2], flow[1], overlap, noise[0])
        precision, pull = sums[:2].astype(np.float32)
        return Change(change, precision, pull, stiffness, misfit.astype(np.float32), overlap, lag)

    def smooth(self, samples: Map, weight: Map, flow: Map, px_per_mm: float) -> Change:
        """The change of given samples (H, W) px of weight (H, W) >= 0, by the same prior and Student's
        weights; otherwise as `solve`."""
        stiffness, prior = self._prior(flow, px_per_mm)
        change = np.zeros_like(samples)
        misfit = np.ones(self.shape, np.float32)
        information, pull = np.zeros((2, *self.shape), np.float32)
        for _ in range(DepthMotion.cold_steps):
            residual = samples - change
            known = weight > 0
            noise = float(np.median(np.square(residual[known]))) / _MEDIAN if known.any() else 1.0
            square = residual * residual / max(noise, 1e-6)
            robust_weight = (
                weight * (_FREEDOM + 1) / (_FREEDOM + square) / (max(noise, 1e-6) * _CORRELATED_PX)
            )
            area = self.cell**2
            information = area * self.average_cells(robust_weight.astype(np.float32))
            pull = area * self.average_cells((robust_weight * samples).astype(np.float32))
            change = interpolate_cells(self._solve_cells(prior, information, pull), self.cell, samples.shape)
            share = self.average_cells(known.astype(np.float32))
            misfit = np.where(
                share > 0, self.average_cells((known * square).astype(np.float32)) / (share + 1e-6), 1
            )
        visible = (weight > 0).astype(np.float32)
        return Change(change, information, pull, stiffness, misfit.astype(np.float32), visible)

    def _solve_cells(self, prior: sparse.csr_matrix, information: Array, pull: Array) -> Map:
        """Changes (h, w) px of the cells that minimise data and prior terms."""
        system = (prior + sparse.diags(information.ravel() + 1e-9)).tocsc()
        factor = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return np.asarray(factor.solve(pull.ravel().astype(np.float64)).reshape(self.shape), np.float32)

    def _prior(self, flow: Map, px_per_mm: float) -> tuple[Map, sparse.csr_matrix]:
        """1 / k^2 (h, w) in 1/px^2, and the matrix of the prior."""
        bend = px_per_mm * (DepthMotion.bend_mm + DepthMotion.strained_mm * self.steepness(flow))
        stiffness = np.asarray(1 / bend**2, np.float32)
        weights = sparse.diags(np.tile(stiffness.ravel().astype(np.float64), 3))
        return stiffness, self._bends.T @ weights @ self._bends

    def steepness(self, flow: Map) -> Map:
        """|grad w| (h, w) [px/px] of w averaged over 3 x 3 cells, which removes the noise."""
        cells = [cv2.blur(self.average_cells(part), (3, 3)) for part in flow]
        slopes = [slope for part in cells for slope in np.gradient(part)]
        slope_norm = np.sqrt(sum(slope * slope for slope in slopes)) / self.cell
        return np.asarray(cv2.blur(np.asarray(slope_norm, np.float32), (3, 3)))

    def average_cells(self, field: Map) -> Map:
        """Means (h, w) of a field (H, W) over cells; at the border the last row or column is repeated."""
        rows, columns = self.shape
        below, right = rows * self.cell - field.shape[0], columns * self.cell - field.shape[1]
        extended = cv2.copyMakeBorder(field, 0, below, 0, right, cv2.BORDER_REPLICATE)
        return np.asarray(cv2.resize(extended, (columns, rows), interpolation=cv2.INTER_AREA))


def interpolate_cells(cells: Map, cell: int, size: tuple[int, ...]) -> Map:
    """Cubic interpolation of a field (h, w) on cells to pixels (H, W)."""
    rows, columns = cells.shape
    upsampled = cv2.resize(cells, (columns * cell, rows * cell), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(upsampled[: size[0], : size[1]])


def second_differences(shape: tuple[int, int]) -> sparse.csr_matrix:
    """Matrix (3 h w, h w) of second differences by x, by y and mixed (times root 2); 0 at the border."""

    def second_difference(n: int) -> sparse.csr_matrix:
        interior = np.ones(n)
        interior[[0, -1]] = 0
        return sparse.diags([interior[1:], -2 * interior, interior[:-1]], [-1, 0, 1], format="csr")

    def first_difference(n: int) -> sparse.csr_matrix:
        interior = np.ones(n)
        interior[-1] = 0
        return sparse.diags([-interior, np.ones(n - 1)], [0, 1], format="csr")

    rows, columns = shape
    horizontal = sparse.kron(sparse.identity(rows), second_difference(columns))
    vertical = sparse.kron(second_difference(rows), sparse.identity(columns))
    mixed = np.sqrt(2) * sparse.kron(first_difference(rows), first_difference(columns))
    return sparse.vstack([horizontal, vertical, mixed]).tocsr()


def _stack_derivatives(picture: Map) -> Map:
    """(3, H, W): the picture and its derivatives by x and y."""
    planes = np.empty((3, *picture.shape), np.float32)
    planes[0] = picture
    kernels.differentiate(picture, planes[1], planes[2])
    return planes


def _noise(residual: Map, mask: Map) -> Map:
    """Robust variance (3,) of each channel of (3, H, W) inside the mask, from the median."""
    samples = residual[:, ::2, ::2][:, mask[::2, ::2] > 0]
    if not samples.shape[1]:
        return np.ones(3, np.float32)
    return np.asarray(np.maximum(np.median(samples * samples, axis=1) / _MEDIAN, 1e-6), np.float32)


def _lag(residual: Map, slope: Map, vertical_flow: Map, mask: Map, noise: np.float32) -> float:
    """Share of the vertical motion that is missing in the right picture, as it is not synchronous.

    Else that motion is the same in both rectified pictures at any depth. (H, W) each: `residual` of
    brightness, of variance `noise`; `slope`, its derivative by y; `vertical_flow`, of the left camera [px].
    """
    stride = (slice(None, None, 2), slice(None, None, 2))
    q, shift = residual[stride], (slope * vertical_flow)[stride]
    weight = mask[stride] / (1 + q * q / (_FREEDOM * noise))
    # A prior of zero lag with the weight of 0.1 px of motion: without motion the lag is unknown.
    ridge = 0.01 * float((weight * slope[stride] ** 2).sum()) + 1e-9
    return float((weight * shift * q).sum()) / (float((weight * shift * shift).sum()) + ridge)


@vectorised
def gather(
    now: Map,
    rest: Map,
    left_sum: Map,
    target: Map,
    mask: Map,
    change: Map,
    noise: Map,
    cell: int,
    sums: Floats,
) -> None:
    """Normal equations of one linearisation, summed over cells.

    Args:
        now, rest: (3, H, W), the warped right picture now and the right rest picture, with their derivatives.
        lefts, less: (3, H, W), the sum of the left pictures at rest and now, and the target of `now`.
        mask, change: (H, W), and (H, W) px, the value of d used for the warp.
        noise, cell: (3,), variance of the channels; px.
        sums: (4, h, w), incremented by J^2, J (J d + q), q^2 (mean over channels) and the number of pixels.
    """
    _, height, width = now.shape
    weight = _ONE / noise
    for y in range(height):
        for x in range(2, width - 2):
            if mask[y, x] == 0:
                continue
            square, slope_product, gradient = np.float32(0), np.float32(0), np.float32(0)
            for k in range(3):
                q = now[k, y, x] - target[k, y, x]
                inner = now[k, y, x + 1] + rest[k, y, x + 1] - now[k, y, x - 1] - rest[k, y, x - 1]
                outer = now[k, y, x + 2] + rest[k, y, x + 2] - now[k, y, x - 2] - rest[k, y, x - 2]
                right_slope = (_EIGHT * inner - outer) * _TWELFTH * _HALF
                inner = left_sum[k, y, x + 1] - left_sum[k, y, x - 1]
                left_slope = (
                    (_EIGHT * inner - (left_sum[k, y, x + 2] - left_sum[k, y, x - 2])) * _TWELFTH * _HALF
                )
                square += weight[k] * q * q
                # A square would be biased by the noise of a slope; the product of two slopes is not.
                slope_product += weight[k] * left_slope * right_slope
                gradient += weight[k] * _HALF * (left_slope + right_slope) * q
            robust_weight = (_FREEDOM + _CHANNELS) / (_FREEDOM + square)
            i, j = y // cell, x // cell
            sums[0, i, j] += robust_weight * slope_product
            sums[1, i, j] += robust_weight * (gradient + slope_product * change[y, x])
            sums[2, i, j] += square / _CHANNELS
            sums[3, i, j] += _ONE
