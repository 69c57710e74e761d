"""Change of disparity since rest, from both eyes' pictures at once: what the second eye adds to a flow.

Unknown is the change d(x) of disparity of what the left rest pixel x sees. With w the left eye's flow and D
the rest disparity, the same tissue is seen at x and x + w in the left eye, and in the right one at x - (D, 0)
and x + w - (D + d, 0): one point, three numbers. The two brightness residuals, left rest to now and right
rest to now, depend on w alike, so that their difference

    q(x, d) = [R_t(x + w - (D + d, 0)) - R_0(x - (D, 0))] - [L_t(x + w) - L_0(x)]

is to first order free of w, of its errors, and of every change of light that both eyes see. Glints, which
they don't share, are masked and weighted down. Minimised is

    E(d) = sum_x  m(x) rho( |(q, d_x q, d_y q) / s|^2 )  +  sum_cells |d2 d|^2 / k^2 ,

pictures being contrast-normalised, s the residuals' median deviation, rho Student's with 4 degrees of
freedom, m the mask (seen in all four pictures), d2 the second differences (a thin plate: G. Wahba, Spline
Models for Observational Data, 1990), and k their standard deviation, in mm the same for every rig. Tissue is
soft where it is strained, so k grows with the gradient of w. d lives on cells of a fortieth of the picture:
tissue under a contact has no finer depth motion, and the system is small. Gauss-Newton on warped pictures,
weights renewed each time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from synth.flow import kernels
from synth.system.jit import vectorised

Map = NDArray[np.float32]
Floats = NDArray[np.float64]

_FREEDOM = np.float32(4.0)  # of Student's distribution
_CHANNELS = np.float32(3.0)
_AROUND = (5, 5)  # cells whose pictures a cell's depth rests on
_ALIKE_PX = 40.0  # errors of a flow are alike over so many pixels
_MEDIAN = 0.4549  # of the square of a standard normal
_ONE, _EIGHT, _TWELFTH, _HALF = np.float32(1), np.float32(8), np.float32(1 / 12), np.float32(0.5)


@dataclass(frozen=True)
class DepthMotionConstants:
    """The prior and the effort: by hand, on renders (docs/results/flow/stereo)."""

    columns: int = 40  # cells across the picture
    bend_mm: float = 0.004  # k where nothing is strained: second differences of depth motion between cells
    strained_mm: float = 2.0  # added to k for each px/px of the flow's gradient
    cold: int = 4  # linearisations from nothing
    warm: int = 2  # linearisations from the frame before


DEPTH = DepthMotionConstants()


@dataclass(frozen=True)
class StereoPictures:
    """The four contrast-normalised pictures, on rectified pixels, and where each is usable; all (H, W)."""

    left_rest: Map
    right_rest: Map  # already on the left rest pixels
    rest_usable: Map  # of both
    left: Map
    right: Map
    left_usable: Map
    right_usable: Map


@dataclass(frozen=True)
class Change:
    """What was found."""

    px: Map  # (H, W) change of disparity
    precision: Map  # (h, w) by cell: how much the pictures say, in 1/px^2; 0 where nothing is seen
    pull: Map  # (h, w) by cell: precision times the change that the pictures alone would have, in 1/px
    stiffness: Map  # (h, w) by cell: 1 / k^2, in 1/px^2
    misfit: Map
    """(h, w) by cell: mean square of the residuals left, in their median's; 1 where nothing is seen."""
    visible: Map  # (H, W) 0 or 1: in all four pictures
    lag: float = 0.0
    """Share of the left eye's motion that the right one doesn't show: of eyes that aren't of one moment."""

    @property
    def deviation(self) -> Map:
        """(h, w) px by cell: the plate's posterior, which knows nothing of errors alike over many pixels."""
        precision = cv2.blur(self.precision, _AROUND, borderType=cv2.BORDER_REPLICATE) + 1e-3
        return np.asarray(1 / np.sqrt(8 * np.sqrt(precision * self.stiffness)), np.float32)


class Solver:
    """The depth solver of one size of picture, with what all frames share."""

    def __init__(self, size: tuple[int, int]) -> None:
        """`size`: (height, width) [px]."""
        height, width = size
        self.cell = max(1, round(width / DEPTH.columns))
        self.shape = (-(-height // self.cell), -(-width // self.cell))
        self._bends = second_differences(self.shape)

    def solve(
        self,
        pictures: StereoPictures,
        flow: Map,
        disparity: Map,
        px_per_mm: float,
        initial: Map | None = None,
    ) -> Change:
        """Change of disparity since rest.

        Args:
            pictures: rest and now.
            flow: (2, H, W) px, the left eye's.
            disparity: (H, W) px at rest, finite everywhere.
            px_per_mm: change of disparity of a point that moves 1 mm away (its size).
            initial: (H, W) px to start from, of the frame before; None: from 0.
        """
        warped, seen = np.empty_like(disparity), np.empty_like(disparity)
        kernels.warp_into(pictures.left, pictures.left_usable, flow, warped, seen)
        left_now, left_rest = self._stacked(warped), self._stacked(pictures.left_rest)
        right_rest = self._stacked(pictures.right_rest)
        lefts, less = left_now + left_rest, left_now - left_rest + right_rest
        mask = pictures.rest_usable * seen
        stiffness = self._stiffness(flow, px_per_mm)
        prior = self._prior(stiffness)
        change = np.zeros_like(disparity) if initial is None else initial
        sums = np.zeros((4, *self.shape), np.float64)
        here = np.empty_like(flow)
        here[1] = flow[1]
        for _ in range(DEPTH.cold if initial is None else DEPTH.warm):
            here[0] = flow[0] - disparity - change
            kernels.warp_into(pictures.right, pictures.right_usable, here, warped, seen)
            both = mask * seen
            right_now = self._stacked(warped)
            noise = _noise(right_now - less, both)
            sums[:] = 0
            gather(right_now, right_rest, lefts, less, both, change, noise, self.cell, sums)
            np.maximum(sums[0], 0, out=sums[0])
            change = fine(self._settled(prior, sums[0], sums[1]), self.cell, disparity.shape)
        misfit = np.where(sums[3] > 0, sums[2] / np.maximum(sums[3], 1), 1)
        lag = _lag(right_now[0] - less[0], right_now[2], flow[1], both, noise[0])
        precision, pull = sums[:2].astype(np.float32)
        return Change(change, precision, pull, stiffness, misfit.astype(np.float32), both, lag)

    def smooth(self, samples: Map, weight: Map, flow: Map, px_per_mm: float) -> Change:
        """The same prior on changes of disparity found elsewhere, pixel by pixel; Student's weights as well.

        Args:
            samples: (H, W) px.
            weight: (H, W) >= 0, 0 where there is none.
            flow: (2, H, W) px, the left eye's.
            px_per_mm: as in `solve`.
        """
        stiffness = self._stiffness(flow, px_per_mm)
        prior = self._prior(stiffness)
        change = np.zeros_like(samples)
        misfit = np.ones(self.shape, np.float32)
        information, pull = np.zeros((2, *self.shape), np.float32)
        for _ in range(DEPTH.cold):
            off = samples - change
            known = weight > 0
            noise = float(np.median(np.square(off[known]))) / _MEDIAN if known.any() else 1.0
            square = off * off / max(noise, 1e-6)
            robust = weight * (_FREEDOM + 1) / (_FREEDOM + square) / (max(noise, 1e-6) * _ALIKE_PX)
            area = self.cell**2
            information = area * self.coarse(robust.astype(np.float32))
            pull = area * self.coarse((robust * samples).astype(np.float32))
            change = fine(self._settled(prior, information, pull), self.cell, samples.shape)
            seen = self.coarse(known.astype(np.float32))
            misfit = np.where(seen > 0, self.coarse((known * square).astype(np.float32)) / (seen + 1e-6), 1)
        visible = (weight > 0).astype(np.float32)
        return Change(change, information, pull, stiffness, misfit.astype(np.float32), visible)

    def _settled(self, prior: sparse.csr_matrix, information: NDArray[Any], pull: NDArray[Any]) -> Map:
        """The cells' changes (h, w) px: data and prior in balance."""
        system = (prior + sparse.diags(information.ravel() + 1e-9)).tocsc()
        factor = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return np.asarray(factor.solve(pull.ravel().astype(np.float64)).reshape(self.shape), np.float32)

    def _stiffness(self, flow: Map, px_per_mm: float) -> Map:
        """1 / k^2 by cell, (h, w), in 1/px^2."""
        bend = px_per_mm * (DEPTH.bend_mm + DEPTH.strained_mm * self.steepness(flow))
        return np.asarray(1 / bend**2, np.float32)

    def _stacked(self, picture: Map) -> Map:
        """(3, H, W): the picture and its derivatives by x and y."""
        found = np.empty((3, *picture.shape), np.float32)
        found[0] = picture
        kernels.differentiate(picture, found[1], found[2])
        return found

    def steepness(self, flow: Map) -> Map:
        """|grad w| [px/px] by cell, of w averaged over 3 x 3 cells: what of it isn't noise."""
        coarse = [cv2.blur(self.coarse(part), (3, 3)) for part in flow]
        slopes = [slope for part in coarse for slope in np.gradient(part)]
        steep = np.sqrt(sum(slope * slope for slope in slopes)) / self.cell
        return np.asarray(cv2.blur(np.asarray(steep, np.float32), (3, 3)))

    def coarse(self, field: Map) -> Map:
        """Means of a field (H, W) by cell, (h, w); the last cells hold fewer pixels."""
        rows, columns = self.shape
        below, right = rows * self.cell - field.shape[0], columns * self.cell - field.shape[1]
        wide = cv2.copyMakeBorder(field, 0, below, 0, right, cv2.BORDER_REPLICATE)
        return np.asarray(cv2.resize(wide, (columns, rows), interpolation=cv2.INTER_AREA))

    def _prior(self, stiffness: Map) -> sparse.csr_matrix:
        weights = sparse.diags(np.tile(stiffness.ravel().astype(np.float64), 3))
        return self._bends.T @ weights @ self._bends


def fine(coarse: Map, cell: int, size: tuple[int, ...]) -> Map:
    """A field by cell, (h, w), on pixels (H, W); cubic."""
    rows, columns = coarse.shape
    wide = cv2.resize(coarse, (columns * cell, rows * cell), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(wide[: size[0], : size[1]])


def second_differences(shape: tuple[int, int]) -> sparse.csr_matrix:
    """Second differences along, across and mixed (by root 2) at each cell, (3 h w, h w); 0 at the border."""

    def second(n: int) -> sparse.csr_matrix:
        inner = np.ones(n)
        inner[[0, -1]] = 0
        return sparse.diags([inner[1:], -2 * inner, inner[:-1]], [-1, 0, 1], format="csr")

    def first(n: int) -> sparse.csr_matrix:
        inner = np.ones(n)
        inner[-1] = 0
        return sparse.diags([-inner, np.ones(n - 1)], [0, 1], format="csr")

    rows, columns = shape
    along = sparse.kron(sparse.identity(rows), second(columns))
    down = sparse.kron(second(rows), sparse.identity(columns))
    mixed = np.sqrt(2) * sparse.kron(first(rows), first(columns))
    return sparse.vstack([along, down, mixed]).tocsr()


def _noise(residual: Map, mask: Map) -> Map:
    """Variance (3,) of each channel of (3, H, W) in the mask, from its median."""
    some = residual[:, ::2, ::2][:, mask[::2, ::2] > 0]
    if not some.shape[1]:
        return np.ones(3, np.float32)
    return np.asarray(np.maximum(np.median(some * some, axis=1) / _MEDIAN, 1e-6), np.float32)


def _lag(residual: Map, slope: Map, down: Map, mask: Map, noise: np.float32) -> float:
    """What part of the motion down the picture is missing in the right eye.

    Rectified eyes show it alike, whatever the depth, so that a residual along the slope is of another moment.

    Args:
        residual: (H, W) of the brightness.
        slope: (H, W) its derivative by y.
        down: (H, W) px, the left eye's flow by y.
        mask: (H, W).
        noise: variance of the residual.
    """
    some = (slice(None, None, 2), slice(None, None, 2))
    q, along = residual[some], (slope * down)[some]
    weight = mask[some] / (1 + q * q / (_FREEDOM * noise))
    # Without motion nothing is late: a prior of a tenth of a pixel's worth.
    little = 0.01 * float((weight * slope[some] ** 2).sum()) + 1e-9
    return float((weight * along * q).sum()) / (float((weight * along * along).sum()) + little)


@vectorised
def gather(
    now: Map, rest: Map, lefts: Map, less: Map, mask: Map, change: Map, noise: Map, cell: int, sums: Floats
) -> None:
    """Normal equations of one linearisation, summed over cells.

    Args:
        now: (3, H, W), the right eye's picture now, warped, with its derivatives.
        rest: (3, H, W), its rest picture.
        lefts: (3, H, W), the sum of the left eye's two.
        less: (3, H, W), what `now` has to equal.
        mask: (H, W).
        change: (H, W) px, d at which `now` was warped.
        noise: (3,), variance of the channels.
        cell: px.
        sums: (4, h, w), added to: J^2, J (J d + q), q^2 (a channel) and the number of pixels.
    """
    _, height, width = now.shape
    weight = _ONE / noise
    for y in range(height):
        for x in range(2, width - 2):
            if mask[y, x] == 0:
                continue
            square, steep, along = np.float32(0), np.float32(0), np.float32(0)
            for k in range(3):
                q = now[k, y, x] - less[k, y, x]
                near = now[k, y, x + 1] + rest[k, y, x + 1] - now[k, y, x - 1] - rest[k, y, x - 1]
                far = now[k, y, x + 2] + rest[k, y, x + 2] - now[k, y, x - 2] - rest[k, y, x - 2]
                right = (_EIGHT * near - far) * _TWELFTH * _HALF
                near = lefts[k, y, x + 1] - lefts[k, y, x - 1]
                left = (_EIGHT * near - (lefts[k, y, x + 2] - lefts[k, y, x - 2])) * _TWELFTH * _HALF
                square += weight[k] * q * q
                # Each eye's slope has noise of its own: their product has none on average, a square has.
                steep += weight[k] * left * right
                along += weight[k] * _HALF * (left + right) * q
            robust = (_FREEDOM + _CHANNELS) / (_FREEDOM + square)
            i, j = y // cell, x // cell
            sums[0, i, j] += robust * steep
            sums[1, i, j] += robust * (along + steep * change[y, x])
            sums[2, i, j] += square / _CHANNELS
            sums[3, i, j] += _ONE
