"""Faults of pictures: nothing to track, dark, noisy, out of focus, compressed, interlaced, repeated."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from synth.arrays import Floats, Map, Mask, Pixels
from synth.flow.recording.finding import Finding
from synth.video import stereo_layout


class Limits:
    """Limits between 50 clean rendered videos, whose values are given, and corrupted ones; the rates of
    detection are in docs/results/scoring/stability."""

    side: int = 24  # px, least side of a picture: windows of the estimators need it
    tissue: int = 400  # px, least area of the tissue
    dark: float = 12.0  # grey levels, 95th percentile of the tissue below which a picture is black
    flat: float = 0.5  # grey levels, least standard deviation of detail; sensor noise is more
    dim: float = 60.0  # grey levels, 95th percentile below which a video is dim; clean: at least 196
    noisy: float = 12.0  # grey levels, largest standard deviation of noise; clean: below 5
    soft: float = 0.34  # least ratio of detail below 1 px to that of 1 to 4 px; clean 0.6, compressed 0.4
    grid: float = 3.0  # largest ratio of steps every eighth pixel to others; clean 1.1, JPEG quality 10 2.5
    blurred: float = 0.5  # least ratio of the finest detail to that of the rest frame; clean: at least 0.87
    combed: float = 1.4  # largest ratio of squared steps to the next row to those to the second; noise 1.2
    bar: float = 0.14  # level of a black bar over that of the picture, at most: black may be 16 of 255
    even: float = 4.0  # grey levels, largest standard deviation within a row of a bar
    same: float = 0.1  # change from picture to picture over the usual one below which a picture is repeated
    still: float = 0.2  # grey levels, least change of the stillest part of a picture with sensor noise
    stillest: float = 0.1  # share of the pictures that may show less, such as those after a repeated one
    noise: float = 1.0  # grey levels, likewise, from which that change is steady; coding makes less vary
    stale: float = 0.7  # that change over the usual one below which the noise is no new one; clean: 0.77
    caught_up: float = 1.6  # change after repeated pictures over the usual one that shows a delay
    leapt: float = 3.0  # change over those before and after that shows a jump
    # Grey levels, change of the picture averaged over 4 x 4 px that is no new coding of its detail: key
    # frames of mp4v and H.264 reach 2.3; the picture displaced by a pixel 7, 5% more light 4.1.
    recoded: float = 3.0
    local: float = 0.5  # median over parts of that change over its mean, below which something moves
    period: tuple[int, int] = (4, 300)  # pictures between key frames
    peak: float = 1.5  # change over those before and after that may be a key frame's
    alike: float = 1.5  # largest ratio of the changes at three key frames


_MAX_LISTED = 5  # most times that a message lists
_HALF_WINDOW = 25  # pictures before and after one in which the usual noise is measured
_STRIDE = 4  # px of the subsampling for comparison, without smoothing: noise distinguishes two pictures


def find_fault(rgb: Pixels, tissue: Mask) -> str:
    """Reason why a picture (H, W, 3) uint8 with a tissue mask (H, W) cannot be tracked; empty if it can."""
    height, width = tissue.shape
    if min(height, width) < Limits.side:
        return f"only {width} x {height} px"
    count = int(tissue.sum())
    if count < Limits.tissue:
        return f"showing only {count} px of tissue"
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    if float(np.percentile(grey[tissue], 95)) < Limits.dark:
        return "black"
    detail = grey - cv2.GaussianBlur(grey, (0, 0), 3)
    if float(detail[tissue].std()) < Limits.flat:
        return "of one colour, without detail"
    return ""


def find_bars(rgb: Pixels) -> Mask:
    """Mask (H, W) of black bars along the borders of a picture (H, W, 3)."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    bars, max_level = np.zeros(grey.shape, bool), Limits.bar * float(np.percentile(grey, 95))
    for lines, bar_lines in ((grey, bars), (grey.T, bars.T)):
        dark = (np.percentile(lines, 98, axis=1) < max_level) & (lines.std(axis=1) < Limits.even)
        bar_lines |= (np.minimum.accumulate(dark) | np.minimum.accumulate(dark[::-1])[::-1])[:, None]
    return bars & ~bars.all()


def is_inside_out(tissue: Mask) -> bool:
    """Whether a tissue mask (H, W) covers the border of the picture but not its middle."""
    height, width = tissue.shape
    border = np.concatenate([tissue[0], tissue[-1], tissue[:, 0], tissue[:, -1]])
    middle = tissue[height // 3 : -(height // 3), width // 3 : -(width // 3)]
    return bool(border.mean() > 0.5 and middle.mean() < 0.5)


class VideoFaults:
    """Faults of the pictures of a video, collected frame by frame."""

    def __init__(self, rgb: Pixels, small: Pixels, tissue: Mask) -> None:
        """Starts with the rest frame (H, W, 3), also downsampled (h, w, 3), and its tissue mask (h, w)."""
        self._tissue, self._rest_rgb, self._last = tissue, small, rgb[::_STRIDE, ::_STRIDE]
        self._last_coarse = _average_squares(rgb)
        self._first = [rgb]  # pictures, from the rest frame on
        self.changes = False  # whether a tracked picture differs from the rest frame
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
        self._fine = _detail(grey, 0, 1)[tissue].std()
        self._numbers: list[int] = []
        self._times: list[float] = []
        # Change since the previous picture: mean, minimum and median over parts of the picture.
        self._changes: list[tuple[float, float, float]] = []
        self._coarse: list[
            tuple[float, float]
        ] = []  # of pictures averaged over squares: mean, median over parts
        self._blurred: list[float] = []
        self._damaged: list[float] = []
        self._decoded = 0
        self._combed: list[float] = []
        level = float(np.percentile(grey[tissue], 95))
        corners = cv2.filter2D(grey, -1, np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32))
        noise = float(np.median(np.abs(corners[tissue]))) / 6 / 0.6745  # Immerkaer 1996, by the median
        sharpness = self._fine / max(float(_detail(grey, 1, 4)[tissue].std()), 1e-6)
        steps = [_grid(lines) for lines in (rgb[..., 1].astype(np.float32), rgb[..., 1].T.astype(np.float32))]
        dim = f"the video is dim: 95% of the tissue is below grey level {level:.0f} of 255"
        no_detail = "the rest frame has no fine detail: is it out of focus or strongly compressed?"
        rest = (
            (level < Limits.dim, dim),
            (noise > Limits.noisy, f"the video is noisy: {noise:.0f} grey levels"),
            (sharpness < Limits.soft, no_detail),
            (min(steps) > Limits.grid, "the pictures have blocks of 8 px: they are strongly compressed"),
        )
        self._rest = [message for is_faulty, message in rest if is_faulty]

    def add_decoded(self, index: int, time_s: float, rgb: Pixels, damaged: bool = False) -> None:
        """Adds a picture (H, W, 3) of the video; every picture in order. `damaged`: not decoded as it was
        taken."""
        self._decoded += 1
        if damaged:
            self._damaged.append(time_s)
        self._first += [rgb] * (len(self._first) < stereo_layout.PICTURES)
        sample, coarse = rgb[::_STRIDE, ::_STRIDE], _average_squares(rgb)
        if sample.shape == self._last.shape:
            change = cv2.absdiff(sample, self._last).mean(axis=2)
            parts = cv2.resize(change, (8, 6), interpolation=cv2.INTER_AREA)
            self._numbers.append(index)
            self._times.append(time_s)
            self._changes.append((float(change.mean()), float(parts.min()), float(np.median(parts))))
            coarse_change = np.abs(coarse - self._last_coarse).mean(axis=2)
            median = float(np.median(cv2.resize(coarse_change, (8, 6), interpolation=cv2.INTER_AREA)))
            self._coarse.append((float(coarse_change.mean()), median))
        self._last, self._last_coarse = sample, coarse  # of another size in a stream that changes its mode

    def add_tracked(self, time_s: float, rgb: Pixels, small: Pixels) -> None:
        """Adds a picture that is tracked, and the same downsampled."""
        self.changes = self.changes or not np.array_equal(small, self._rest_rgb)
        fine = _detail(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), 0, 1)[self._tissue].std()
        if fine < Limits.blurred * self._fine:
            self._blurred.append(time_s)
        green = rgb[:, ::2, 1].astype(np.float32)
        adjacent, alternate = (
            cv2.blur((green[:-2] - green[k : len(green) - 2 + k]) ** 2, (8, 16)) for k in (1, 2)
        )
        # The blocks of largest ratio: elsewhere the picture may be at rest.
        ratio = (adjacent / (alternate + 1))[8::16, 4::8]
        if ratio.size and np.percentile(ratio, 98) > Limits.combed:
            self._combed.append(time_s)

    def repeats(self) -> tuple[dict[int, int], dict[int, int]]:
        """Repeated pictures as {number: number of the picture shown}, certain ones, and those for which the
        tissue may just have been still. The rest frame has number -1."""
        change, minimum, median = np.array(self._changes).reshape(-1, 3).T
        certain, possible = dict[int, int](), dict[int, int]()
        if not change.any():
            return certain, possible
        usual_change = float(np.median(change[change > 0]))
        # Noise on copies of a picture hides that they are equal, but each new exposure has noise of its own.
        # It must be usual before and after: a change of light or gain changes it for good.
        levels = np.column_stack([minimum, median])
        padded = np.pad(levels, ((_HALF_WINDOW, _HALF_WINDOW - 1), (0, 0)), constant_values=np.nan)
        before = np.nanmedian(sliding_window_view(padded, _HALF_WINDOW + 1, axis=0)[: len(levels)], axis=-1)
        after = np.nanmedian(sliding_window_view(padded, _HALF_WINDOW, axis=0)[_HALF_WINDOW:], axis=-1)
        floor = np.minimum(before, after)
        stale = ((floor > Limits.noise) & (levels < Limits.stale * floor)).all(axis=1)
        same = np.concatenate([[False], stale | (change < Limits.same * usual_change), [False]]).astype(int)
        # A coder that repeats still parts of a picture leaves some without any change in most videos.
        new_minimum = minimum[same[1:-1] == 0]
        noisy = len(new_minimum) > 0 and float(np.quantile(new_minimum, Limits.stillest)) > Limits.still
        for first, stop in zip(*(np.flatnonzero(np.diff(same) == k) for k in (1, -1)), strict=True):
            caught_up = (
                stop < len(change)
                and change[stop] > Limits.caught_up * usual_change
                and not self._is_recoded(stop)
            )
            shown = self._numbers[first - 1] if first else -1
            (certain if noisy or caught_up else possible).update(
                dict.fromkeys(self._numbers[first:stop], shown)
            )
        return certain, possible

    def _is_recoded(self, k: int) -> bool:
        """Whether the k-th change is evenly small over the picture: its detail was coded anew."""
        mean, median = self._coarse[k]
        return Limits.local * mean < median < Limits.recoded

    def _find_leaps(self) -> list[int]:
        """Numbers of the changes of the whole picture that exceed those before and after.

        The median over parts ignores an instrument that enters; a cut or bump changes most of the picture.
        Key frames code detail anew: that is small in pictures averaged over squares, or periodic.
        """
        fine, coarse = (
            np.array(values)[:, -1] if values else np.zeros(0) for values in (self._changes, self._coarse)
        )
        if len(fine) < 3:
            return []
        ratios = [
            values[1:-1] / np.maximum(np.maximum(values[:-2], values[2:]), 1e-6) for values in (fine, coarse)
        ]
        leapt = np.append(0.0, np.minimum(*ratios)) > Limits.leapt
        peaks = {int(k) for k in 1 + np.flatnonzero(ratios[1] > Limits.peak)}
        return [
            int(k)
            for k in np.flatnonzero(leapt & (coarse[: len(leapt)] > Limits.recoded))
            if not _is_periodic(int(k), peaks, coarse)
        ]

    @cached_property
    def _layout(self) -> str:
        return stereo_layout.find_layout(self._first)

    def findings(self) -> list[Finding]:
        """Findings after the last frame."""
        repeats = self.repeats()[0]
        leaps = [k for k in self._find_leaps() if not repeats.keys() & set(self._numbers[k - 1 : k + 2])]
        cuts = [self._times[k] for k in leaps]
        time_s = dict(zip(self._numbers, self._times, strict=True))
        findings = [Finding("warning", "pictures", message) for message in self._rest]
        if self._layout:
            advice = f"two cameras in one video: split it by bench import --stereo-layout {self._layout}"
            message = stereo_layout.MIXED.get(self._layout, advice)
            findings.append(Finding("error", "pictures", message))
        combed = [] if self._layout else self._combed  # rows of two cameras differ as two fields do
        for times, fault in (
            (self._damaged, f"damaged in the video's file, of {self._decoded}: they are lost; copy it again"),
            (combed, "interlaced: deinterlace the video"),
            (self._blurred, "much less sharp than the rest frame: are they out of focus?"),
            ([time_s[k] for k in sorted(repeats)], "the previous one again: frozen or doubled"),
            (cuts, "unlike their neighbours: are frames missing, or is there a cut, a bump or other light?"),
        ):
            if times:
                examples = ", ".join(f"{t:.2f}" for t in times[:_MAX_LISTED])
                examples += ", ..." if len(times) > _MAX_LISTED else ""
                message = f"{len(times)} pictures ({examples} s) are {fault}"
                findings.append(Finding("warning", "pictures", message))
        return findings


def _average_squares(rgb: Pixels) -> Map:
    """A picture (H, W, 3) averaged over squares of `_STRIDE` px."""
    height, width = (max(side // _STRIDE, 1) for side in rgb.shape[:2])
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _is_periodic(k: int, peaks: set[int], change: Floats) -> bool:
    """Whether the k-th of the changes (T,) is one of three `peaks` of equal height at equal distances."""
    for period in range(Limits.period[0], Limits.period[1] + 1):
        for triple in (
            (k - period, k, k + period),
            (k - 2 * period, k - period, k),
            (k, k + period, k + 2 * period),
        ):
            if peaks.issuperset(triple) and np.ptp(np.log(change[list(triple)])) < np.log(Limits.alike):
                return True
    return False


def _detail(grey: Map, finer: float, coarser: float) -> Map:
    """Difference (H, W) of a picture blurred by two Gaussians [px]; a width of 0 means no blur."""
    top = cv2.GaussianBlur(grey, (0, 0), finer) if finer else grey
    return np.asarray(top - cv2.GaussianBlur(grey, (0, 0), coarser), np.float32)


def _grid(lines: Map) -> float:
    """Mean step between columns (H, W) on a grid of 8 px, over the median of the eight possible grids."""
    steps = np.abs(np.diff(lines, axis=1)).mean(axis=0)
    grid_means = [float(steps[k::8].mean()) for k in range(8)]
    return max(grid_means) / max(float(np.median(grid_means)), 1e-6)
