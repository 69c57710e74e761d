"""Pictures that show nothing to follow, and videos whose pictures were corrupted after the camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.recording_flow.finding import Finding


@dataclass(frozen=True)
class Thresholds:
    """When a picture or a video is faulty: between 50 rendered videos, whose values stand last, and the same
    corrupted; docs/results/scoring/stability has what they find."""

    side: int = 24  # px of the picture at least: no window of any estimator fits into less
    tissue: int = 400  # px at least
    dark: float = 12.0  # grey levels that 95% of the tissue stay below
    flat: float = 0.5  # grey levels of detail; a camera's own noise is more
    dim: float = 60.0  # as `dark`; 196 and more
    noisy: float = 12.0  # grey levels, one standard deviation; below 5
    soft: float = 0.34  # detail finer than 1 px over that of 1 to 4 px; 0.6 and more, strongly compressed 0.4
    grid: float = 3.0  # steps at every eighth pixel over those between; 1.1, of JPEG at quality 10 2.5
    blurred: float = 0.5  # of the rest frame's finest detail; 0.87 and more
    combed: float = 1.4  # squared steps to the next row over those to the one after it; 1.1, of noise 1.2
    bar: float = 0.14  # of the picture's level, that a black bar stays below: 16 of 255 may be black
    even: float = 4.0  # grey levels, spread within a row of it
    same: float = 0.1  # of the usual change from picture to picture
    still: float = 0.2  # grey levels by which even the stillest part of a camera's picture changes
    caught_up: float = 1.6  # usual changes after pictures that stood still
    leapt: float = 3.0  # times as much change as from the pictures on either side


LIMITS = Thresholds()
_SOME = 5  # of a list that are named
_STRIDE = 4  # every such pixel is compared, unsmoothed: noise tells two pictures apart


def find_fault(rgb: NDArray[np.uint8], tissue: NDArray[np.bool_]) -> str:
    """Why nothing can be followed in a picture; empty if something may be.

    Args:
        rgb: (H, W, 3) uint8.
        tissue: (H, W).
    """
    height, width = tissue.shape
    if min(height, width) < LIMITS.side:
        return f"only {width} x {height} px large"
    count = int(tissue.sum())
    if count < LIMITS.tissue:
        return f"only {count} px of it are tissue"
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    if float(np.percentile(grey[tissue], 95)) < LIMITS.dark:
        return "black"
    detail = grey - cv2.GaussianBlur(grey, (0, 0), 3)
    if float(detail[tissue].std()) < LIMITS.flat:
        return "of one colour, without any detail"
    return ""


def find_bars(rgb: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) True on the black bars along the borders of a picture (H, W, 3)."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    bars, least = np.zeros(grey.shape, bool), LIMITS.bar * float(np.percentile(grey, 95))
    for lines, across in ((grey, bars), (grey.T, bars.T)):
        dark = (np.percentile(lines, 98, axis=1) < least) & (lines.std(axis=1) < LIMITS.even)
        across |= (np.minimum.accumulate(dark) | np.minimum.accumulate(dark[::-1])[::-1])[:, None]
    return bars & ~bars.all()


def is_inside_out(tissue: NDArray[np.bool_]) -> bool:
    """Whether a mask (H, W) of tissue marks the border of the picture and leaves out its middle."""
    height, width = tissue.shape
    border = np.concatenate([tissue[0], tissue[-1], tissue[:, 0], tissue[:, -1]])
    middle = tissue[height // 3 : -(height // 3), width // 3 : -(width // 3)]
    return bool(border.mean() > 0.5 and middle.mean() < 0.5)


class VideoFaults:
    """What a film's pictures suffer from, gathered as they go by."""

    def __init__(self, rgb: NDArray[np.uint8], small: NDArray[np.uint8], tissue: NDArray[np.bool_]) -> None:
        """The rest frame (H, W, 3), the same as flow is computed on, (h, w, 3), and (h, w) its tissue."""
        self._tissue, self._last = tissue, rgb[::_STRIDE, ::_STRIDE]
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
        self._fine = _detail(grey, 0, 1)[tissue].std()
        self._numbers: list[int] = []
        self._times: list[float] = []
        # Since the one before: mean, of the quietest part, and of the middling one.
        self._changes: list[tuple[float, float, float]] = []
        self._blurred: list[float] = []
        self._combed: list[float] = []
        level = float(np.percentile(grey[tissue], 95))
        corners = cv2.filter2D(grey, -1, np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32))
        noise = float(np.median(np.abs(corners[tissue]))) / 6 / 0.6745  # Immerkaer 1996, by the median
        soft = self._fine / max(float(_detail(grey, 1, 4)[tissue].std()), 1e-6)
        steps = [_grid(lines) for lines in (rgb[..., 1].astype(np.float32), rgb[..., 1].T.astype(np.float32))]
        self._rest = [
            said
            for wrong, said in (
                (
                    level < LIMITS.dim,
                    f"the film is dim: 95% of the tissue is below grey level {level:.0f} of 255",
                ),
                (noise > LIMITS.noisy, f"the film is noisy: {noise:.0f} grey levels"),
                (
                    soft < LIMITS.soft,
                    "the rest frame has no fine detail: out of focus, or strongly compressed?",
                ),
                (min(steps) > LIMITS.grid, "the pictures fall into blocks of 8 px: strongly compressed"),
            )
            if wrong
        ]

    def see(self, index: int, time_s: float, rgb: NDArray[np.uint8]) -> None:
        """A picture (H, W, 3) of the film, each in order."""
        one = rgb[::_STRIDE, ::_STRIDE]
        if one.shape == self._last.shape:
            change = cv2.absdiff(one, self._last).mean(axis=2)
            parts = cv2.resize(change, (8, 6), interpolation=cv2.INTER_AREA)
            self._numbers.append(index)
            self._times.append(time_s)
            self._changes.append((float(change.mean()), float(parts.min()), float(np.median(parts))))
        self._last = one

    def look(self, time_s: float, rgb: NDArray[np.uint8], small: NDArray[np.uint8]) -> None:
        """A picture that is followed, and the same as flow is computed on."""
        fine = _detail(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), 0, 1)[self._tissue].std()
        if fine < LIMITS.blurred * self._fine:
            self._blurred.append(time_s)
        green = rgb[:, ::2, 1].astype(np.float32)
        near, far = (cv2.blur((green[:-2] - green[k : len(green) - 2 + k]) ** 2, (8, 16)) for k in (1, 2))
        # The most torn blocks: elsewhere the picture may be at rest.
        torn = (near / (far + 1))[8::16, 4::8]
        if torn.size and np.percentile(torn, 98) > LIMITS.combed:
            self._combed.append(time_s)

    def repeats(self) -> tuple[dict[int, int], dict[int, int]]:
        """Frames that show an earlier one again, surely, and unless the tissue was still: number → of which.

        The rest frame's number is -1.
        """
        change, quiet, _ = np.array(self._changes).reshape(-1, 3).T
        surely, maybe = dict[int, int](), dict[int, int]()
        if not change.any():
            return surely, maybe
        usual = float(np.median(change[change > 0]))
        noisy = float(np.median(quiet[change > 0])) > LIMITS.still
        same = np.concatenate([[False], change < LIMITS.same * usual, [False]]).astype(int)
        for first, stop in zip(*(np.flatnonzero(np.diff(same) == k) for k in (1, -1)), strict=True):
            caught_up = stop < len(change) and change[stop] > LIMITS.caught_up * usual
            shown = self._numbers[first - 1] if first else -1
            (surely if noisy or caught_up else maybe).update(dict.fromkeys(self._numbers[first:stop], shown))
        return surely, maybe

    def findings(self) -> list[Finding]:
        """What is odd, once the film is through."""
        # An instrument may come in at once; a cut or a bump changes most of the picture.
        again, change = self.repeats()[0], [middling for *_, middling in self._changes]
        beside = [max(pair) for pair in zip(change[:-2], change[2:], strict=True)]
        leaps = [k for k, other in enumerate(beside, 1) if change[k] > LIMITS.leapt * other]
        at = dict(zip(self._numbers, self._times, strict=True))
        found = [Finding("odd", "pictures", said) for said in self._rest]
        for times, said in (
            (self._combed, "interlaced: rows are of two moments; deinterlace the film"),
            (self._blurred, "far less sharp than the rest frame: out of focus?"),
            ([at[k] for k in sorted(again)], "the one before again: frozen or doubled"),
            (
                [self._times[k] for k in leaps if not again.keys() & set(self._numbers[k - 1 : k + 2])],
                "far from those beside: frames missing, a cut or a bump?",
            ),
        ):
            if times:
                some = ", ".join(f"{t:.2f}" for t in times[:_SOME]) + (", ..." if len(times) > _SOME else "")
                found.append(Finding("odd", "pictures", f"{len(times)} pictures ({some} s) are {said}"))
        return found


def _detail(grey: NDArray[np.float32], finer: float, coarser: float) -> NDArray[np.float32]:
    """What of a picture (H, W) lies between two widths of Gaussians [px]; 0: the picture itself."""
    top = cv2.GaussianBlur(grey, (0, 0), finer) if finer else grey
    return np.asarray(top - cv2.GaussianBlur(grey, (0, 0), coarser), np.float32)


def _grid(lines: NDArray[np.float32]) -> float:
    """Mean step at the columns (H, W) of a grid of 8 px over the median of others."""
    steps = np.abs(np.diff(lines, axis=1)).mean(axis=0)
    each = [float(steps[k::8].mean()) for k in range(8)]
    return max(each) / max(float(np.median(each)), 1e-6)
