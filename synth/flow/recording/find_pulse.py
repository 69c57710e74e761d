"""Pulsation of the tissue by heart and breath, estimated over a recording so that it can be removed.

Unlike contacts, heart and breath are periodic, move the whole surface, and continue without contact. A rhythm
is therefore a smooth motion of the surface (polynomials in x and y) times harmonics of one phase, whose rate
may vary. It is fitted to frames without contact and must predict held-out frames. If these frames are not
given, they are found by iterative trimming (compare least trimmed squares: Rousseeuw, J. Amer. Stat. Assoc.
79, 1984). A phase that varies by more than a radian is not found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np

from synth.arrays import Floats, Map, Mask
from synth.flow.recording.camera_path import CameraPath
from synth.flow.recording.harmonic_fit import Rhythm, Span, find_rhythms, fit, visible_rates


class Cell:
    """Constants of the cells and of frames without contact, chosen by hand on `evidence.scoring.pulse`."""

    columns: int = 20  # cells across the picture
    degree: int = 4  # of the polynomials in x and y
    min_visible: float = 0.3  # least visible share of a cell
    min_frames: int = 30  # least frames without contact: more than one contact's, 2.5 s at 10 Hz
    max_rest_noise_px: float = 0.15  # largest displacement of a cell by noise of the rest frame
    smooth_share: float = 0.2  # share of the frames that is assumed to be without contact
    smooth_factor: float = 2.0  # a frame is smooth if its misfit is below this times their largest
    explained_factor: float = 2.5  # explained by rhythms: below this times the smooth frames' median
    noise_px: float = 1e-3  # added to both limits


@dataclass
class SurfaceMotion:
    """Motion of tissue averaged over a grid of cells, frame by frame.

    Its C components, in pixels of the rest frame, are x and y in the picture; in stereo also motion in three
    dimensions, first along the optical axis, then lateral.
    """

    tissue: Mask  # (h, w)
    time_s: list[float] = field(default_factory=list)
    motion: list[Map] = field(default_factory=list)  # (r, c, C) each
    visible: list[Map] = field(default_factory=list)  # (r, c) visible share of each cell
    depth_weight: float = 1.0  # of motion along the axis in the search for rhythms, by its precision

    def add(self, time_s: float, motion: Map, confidence: Map) -> None:
        """Adds the motion (h, w, C) and confidence (h, w) of a trusted frame."""
        mean, share = average_cells(motion, confidence * self.tissue)
        self.time_s.append(time_s)
        self.motion.append(mean)
        self.visible.append(share)


def average_cells(motion: Map, weight: Map) -> tuple[Map, Map]:
    """Weighted mean (r, c, C) over cells of a motion (h, w, C), and mean (r, c) of the weight (h, w)."""
    height, width = weight.shape
    size = (Cell.columns, max(2, round(Cell.columns * height / width)))
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    parts = [motion[..., k : k + 3] for k in range(0, motion.shape[2], 3)]  # cv2: 4 channels at most
    total = np.dstack([cv2.resize(p * weight[..., None], size, interpolation=cv2.INTER_AREA) for p in parts])
    mean = total / np.maximum(share, 1e-6)[..., None]
    return np.asarray(mean, np.float32), np.asarray(share, np.float32)


@dataclass(frozen=True, eq=False)
class PulseEstimate:
    """The rhythms of a recording, in the components of its surface motion."""

    rhythms: tuple[Rhythm, ...]
    basis: Map  # (h, w, B) polynomials at the pixels; 0 outside the tissue
    offset: Floats  # (B, C) coefficients that make the motion zero at the time of the rest frame
    rest_noise: Map  # (h, w, C) constant residual of frames without contact
    amplitudes_px: tuple[float, ...]  # of each rhythm, in 3D if known: median over the tissue

    def at(self, time_s: float) -> Map:
        """Pulsation (h, w, C) since the rest frame, with the noise of the rest frame."""
        coefficients = sum((rhythm.at(np.array([time_s]))[0] for rhythm in self.rhythms), self.offset)
        return np.asarray(self.basis @ coefficients.astype(np.float32) + self.rest_noise, np.float32)

    def describe(self, mm_per_px: float) -> str:
        """A sentence on amplitudes and rates; `mm_per_px`: of the pixels of the flow."""
        parts = [
            f"{mm_per_px * amplitude:.2g} mm at {rhythm.rate_hz:.3g} Hz"
            for rhythm, amplitude in zip(self.rhythms, self.amplitudes_px, strict=True)
        ]
        return f"the whole surface pulsates by {' and '.join(parts)}: this motion is removed"


@dataclass(frozen=True, eq=False)
class PulseSearch:
    """Result of a search for rhythms."""

    pulse: PulseEstimate | None  # None: not found
    free_s: Floats  # times of the tracked frames that are assumed to be without contact
    rates_hz: Span | None  # searched rates; None: no search was possible
    reason: str = ""  # why no search was possible
    camera: CameraPath | None = None  # camera motion found on the tissue; None: none, or on surroundings
    is_living: bool = True  # False: tissue that doesn't pulsate, so that no rhythm was searched

    def describe(self) -> str:
        """A sentence on pulsation that the search may have missed; empty if it covers heart and breath."""
        if not self.is_living:
            return ""
        if self.rates_hz is None:
            warning = "Pulsation of the tissue, if any, is not removed"
            return f"heart and breath were not searched: {self.reason}. {warning}"
        low, high = self.rates_hz
        if low <= 0.21 and high >= 1.5:  # breath under anaesthesia, 12 a minute, and a fast heart, 90
            return ""
        prefix = "no heart or breath was found, but " if self.pulse is None else "of heart and breath, "
        sentence = f"only rates from {low:.2g} to {high:.2g} Hz show in {_describe_frames(self.free_s)}"
        return f"{prefix}{sentence}. Slower or faster pulsation is not removed"


def find_pulse(surface: SurfaceMotion, rest_s: float, free_s: Sequence[Span] = ()) -> PulseSearch:
    """Searches frames without contact for rhythms of the surface; the rest frame is at `rest_s` [s].

    `free_s`: spans known to be without contact [s]; if too short, smooth and periodic frames are used, too.
    """
    time_s = np.array(surface.time_s)
    if len(time_s) < Cell.min_frames:
        return _report_too_few(time_s)
    cells = _Cells(surface, np.array([1.0, 1.0, surface.depth_weight])[: surface.motion[0].shape[2]])
    usable = (cells.weight > 0).mean(axis=1) > 0.5 if cells.used.any() else np.zeros(len(time_s), bool)
    if len(cells.basis) < 2 * cells.basis.shape[1] or usable.sum() < Cell.min_frames:
        return PulseSearch(None, time_s[usable], None, "too little of the picture is tracked tissue")
    smooth = usable & np.any([(time_s >= start) & (time_s <= stop) for start, stop in free_s], axis=0)
    is_stated = smooth.sum() >= Cell.min_frames and visible_rates(time_s[smooth]) is not None
    if not is_stated:
        # Frames about as smooth as the smoothest fifth: motion by a contact is less smooth.
        misfit = cells.misfit(cells.coefficients)
        max_misfit = Cell.smooth_factor * np.quantile(misfit[usable], Cell.smooth_share) + Cell.noise_px
        smooth |= usable & (misfit <= max_misfit)
    rates_hz = visible_rates(time_s[smooth]) if smooth.sum() >= Cell.min_frames else None
    if rates_hz is None:
        return _report_too_few(time_s[smooth])
    rhythms, rejected, fitted = _trim_frames(cells, usable, smooth, rounds=1 if is_stated else 4)
    if rhythms:
        pulse = _estimate(surface, rhythms, rejected, fitted, rest_s)
        return PulseSearch(pulse, time_s[fitted], rates_hz)
    return PulseSearch(None, time_s[smooth], rates_hz)


def _report_too_few(free_s: Floats) -> PulseSearch:
    return PulseSearch(None, free_s, None, f"{_describe_frames(free_s)} are too few")


def _describe_frames(free_s: Floats) -> str:
    span = f" from {free_s.min():.3g} to {free_s.max():.3g} s" if len(free_s) else ""
    return f"the {len(free_s)} smoothest tracked frames{span}"


class _Cells:
    """The P cells of a surface that are visible in most frames, and the smooth motion fitted to them."""

    def __init__(self, surface: SurfaceMotion, weight: Floats | None = None) -> None:
        """`weight`: (c,) of the first c components, the only ones used; None: all components."""
        visible = np.stack(surface.visible).astype(np.float64)
        count, rows, columns = visible.shape
        y, x = np.mgrid[:rows, :columns] + 0.5
        positions = np.column_stack([x.ravel() / columns, y.ravel() / rows])
        visible = visible.reshape(count, -1)
        self.time_s = np.array(surface.time_s)
        self.used = np.median(visible, axis=0) > Cell.min_visible  # (r c,)
        self.basis = _polynomials(positions[self.used])  # (P, B)
        self.weight = np.where(visible[:, self.used] > Cell.min_visible, visible[:, self.used], 0.0)  # (T, P)
        motion = np.stack(surface.motion).reshape(*visible.shape, -1).astype(np.float64)[:, self.used]
        self.motion = motion if weight is None else motion[..., : len(weight)] * weight  # (T, P, C)

    @cached_property
    def coefficients(self) -> Floats:
        """Coefficients (T, B, C) of the polynomials that fit each frame best; 0 where no cell is visible."""
        gram = np.einsum("tp,pa,pb->tab", self.weight, self.basis, self.basis, optimize=True)
        size = gram.shape[1]
        mean = np.trace(gram, axis1=1, axis2=2)[:, None, None] / size
        gram += np.where(mean > 0, 1e-3 * mean, 1.0) * np.eye(size)
        rhs = np.einsum("tp,pa,tpc->tac", self.weight, self.basis, self.motion, optimize=True)
        return np.asarray(np.linalg.solve(gram, rhs), np.float64)

    def misfit(self, coefficients: Floats) -> Floats:
        """Root mean square residual (T,) over cells for coefficients (T, B, C)."""
        residual = self.motion - np.einsum("pa,tac->tpc", self.basis, coefficients)
        total = (np.square(residual).sum(axis=2) * self.weight).sum(axis=1)
        return np.asarray(np.sqrt(total / np.maximum(self.weight.sum(axis=1), 1e-9)), np.float64)

    def rest_noise(self, free: Mask) -> Floats:
        """Median residual (P, C) over the frames `free` (T,), limited to the size of noise: noise of the rest
        frame displaces a cell equally in all frames."""
        residual = self.motion[free] - np.einsum("pa,tac->tpc", self.basis, self.coefficients[free])
        residual[self.weight[free] == 0] = np.nan
        is_visible = (self.weight[free] > 0).mean(axis=0) > 0.5
        noise = np.zeros(residual.shape[1:])
        noise[is_visible] = np.nanmedian(residual[:, is_visible], axis=0)
        for part in (noise[:, :2], noise[:, 2:3], noise[:, 3:]):
            length = np.linalg.norm(part, axis=1, keepdims=True)
            part *= np.minimum(1, Cell.max_rest_noise_px / np.maximum(length, 1e-9))
        return noise


def _trim_frames(
    cells: _Cells, usable: Mask, smooth: Mask, rounds: int
) -> tuple[tuple[Rhythm, ...], tuple[Rhythm, ...], Mask]:
    """Alternates `find_rhythms` and the selection of the frames (T,) that it explains."""
    free = fitted = smooth
    rhythms = rejected = tuple[Rhythm, ...]()
    for _ in range(rounds):
        fitted = free
        if fitted.sum() < Cell.min_frames:
            return (), (), fitted
        rhythms, rejected = find_rhythms(cells.time_s[fitted], cells.coefficients[fitted], cells.basis)
        if not rhythms:
            break
        prediction = _sum((*rhythms, *rejected), cells.time_s)
        misfit = cells.misfit(prediction + (cells.coefficients - prediction)[fitted].mean(axis=0))
        # The limit is relative to smooth frames: relative to fitted ones it would admit contacts.
        free = usable & (misfit <= Cell.explained_factor * np.median(misfit[smooth]) + Cell.noise_px)
        if (free == fitted).all():
            break
    return rhythms, rejected, fitted


def _estimate(
    surface: SurfaceMotion, rhythms: Sequence[Rhythm], rejected: Sequence[Rhythm], free: Mask, rest_s: float
) -> PulseEstimate:
    """Fits rhythms of known phase to all components in the frames `free` (T,), with offset and rest noise."""
    cells = _Cells(surface)
    t, coefficients = cells.time_s[free], cells.coefficients[free]
    fitted = fit(t, coefficients.reshape(len(t), -1), (*rhythms, *rejected), np.eye(coefficients.shape[1]))
    accepted, rejected = fitted[: len(rhythms)], fitted[len(rhythms) :]
    # The offset at rest is fitted to all frames, which is more precise than the phase at that moment.
    residual = coefficients - _sum(accepted, t) - (_sum(rejected, t) - _sum(rejected, np.array([rest_s])))
    trend = np.column_stack([np.ones(len(t)), t - rest_s])
    offset = np.linalg.lstsq(trend, residual.reshape(len(t), -1), rcond=None)[0][0]
    offset = offset.reshape(residual.shape[1:])
    (rows, columns, components), (height, width) = surface.motion[0].shape, surface.tissue.shape
    noise = np.zeros((len(cells.used), components), np.float32)
    noise[cells.used] = cells.rest_noise(free)
    y, x = np.mgrid[:height, :width] + 0.5
    basis = _polynomials(np.column_stack([x.ravel() / width, y.ravel() / height])).reshape(height, width, -1)
    tissue = surface.tissue[..., None]
    reported = slice(2 if components > 2 else 0, None)
    amplitudes = (
        replace(rhythm, modes=rhythm.modes[..., reported]).amplitude(cells.basis) for rhythm in accepted
    )
    return PulseEstimate(
        tuple(accepted),
        (basis * tissue).astype(np.float32),
        np.asarray(offset, np.float64),
        cv2.resize(noise.reshape(rows, columns, components), (width, height)) * tissue,
        tuple(float(np.median(amplitude)) for amplitude in amplitudes),
    )


def _sum(rhythms: Sequence[Rhythm], time_s: Floats) -> Floats:
    """Sum (T, B, C) of the coefficients of several rhythms; 0 without any."""
    return np.asarray(sum((rhythm.at(time_s) for rhythm in rhythms), np.zeros(1)), np.float64)


def _polynomials(positions: Floats) -> Floats:
    """Products (P, B) of Legendre polynomials up to `Cell.degree` at places (P, 2) in 0..1."""
    x, y = (np.polynomial.legendre.legvander(2 * axis - 1, Cell.degree) for axis in positions.T)
    pairs = [(i, j) for i in range(Cell.degree + 1) for j in range(Cell.degree + 1 - i)]
    return np.stack([x[:, i] * y[:, j] for i, j in pairs], axis=1)
