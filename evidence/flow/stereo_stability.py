"""`bench stability stereo`: two eyes made worse one thing at a time; is depth that is wrong said to be?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
import typer
from numpy.typing import NDArray

from bench.output import charts, result_page
from bench.recording import check
from bench.recording.second_eye import LATE
from evidence.flow.stereo import rig_of
from evidence.measuring import measuring
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.flow import mask
from synth.flow.stereo.rig import Rig
from synth.flow.stereo.track import StereoTracker, still_frames

Film = NDArray[np.uint8]
Floats = NDArray[np.float64]

WRONG_MM = 0.10
"""Depth motion off by more (rms over seen tissue) is of little use for force."""
_MOVED_PX = 0.5  # less says nothing of when
_SAYS = 2.0  # a stated deviation this many times too small says nothing


@dataclass(frozen=True)
class View:
    """What the tracker is given of a sequence."""

    rig: Rig
    right: Film
    """(T, H, W, 3)."""


Spoil = Callable[[View, np.random.Generator], View]


@measuring(
    "b24-320 b4-320 b12-320 b30-320",
    out="docs/results/flow/stereo-stability",
    file="stability.json",
    page=lambda found, folder: result_page.write(drawn(found), folder),
    text="index.html",
)
def stability(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Stereo datasets with recovered flow: one that is made worse, then others of its scenes "
            "with other baselines."
        ),
    ],
    count: Annotated[int, typer.Option(min=1, help="Sequences of each.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of what is drawn: where blobs of glare lie.")] = 0,
) -> dict[str, Any]:
    """Depth motion under trouble: its error, the deviation stated, and whether anything flags it."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = []
    for trouble, value, spoil in troubles():
        rows.append(_point(data[0], trouble, value, spoil, count, seed))
        typer.echo(f"{trouble} {value:g}: {rows[-1]['rms_mm']} mm", err=True)
    for root in data:
        base = float(Dataset(root)[0].attrs["right"]["baseline_mm"])
        rows.append(_point(root, "baseline [mm]", base, lambda view, rng: view, count, seed))
    return {
        "meaning": f"rms_mm: error of depth motion over seen tissue; stated_mm: rms of its stated deviation; "
        "epipolar_px: what the rest pair says of the calibration; lag: share of motion that the right eye "
        "doesn't show, exceeded in a tenth of frames; flagged (as by bench check): stated_mm at least "
        f"{check.NOISY_MM}, epipolar_px above {check.OFF_ROWS_PX} or lag above {LATE}, or refused; "
        "silent: "
        f"rms_mm above {WRONG_MM}, more than {_SAYS:g} times what is stated, and not flagged",
        "rows": rows,
    }


def troubles() -> Iterator[tuple[str, float, Spoil]]:
    """Name, size and what is done to the right eye."""
    for px in (0.0, 0.2, 0.5, 1.0, 2.0):
        yield "rows off [px]", px, _turned(px, 0)
    for px in (0.2, 0.5, 1.0, 2.0):
        yield "columns off [px]", px, _turned(px, 1)
    for frames in (1.0, 2.0):
        yield "right eye late [frames]", frames, _late(int(frames))
    for gain in (0.5, 0.7, 0.85, 1.15, 1.3):
        yield "right eye's exposure", gain, _exposed(gain)
    for share in (0.25, 0.5, 1.0):
        yield "right eye blocked [share]", share, _blocked(share)
    for share in (0.05, 0.12, 0.25):
        yield "glare in the right eye [share]", share, _glared(share)


def _turned(px: float, axis: int) -> Spoil:
    """The calibration says that the right camera is turned so that rows (0) or columns (1) are off."""

    def spoil(view: View, rng: np.random.Generator) -> View:
        angle = np.zeros(3)
        angle[axis] = px / view.rig.right.K[0, 0]
        turn = np.asarray(cv2.Rodrigues(angle)[0], np.float64)
        rig = replace(view.rig, rotation=turn @ view.rig.rotation, translation=turn @ view.rig.translation)
        return replace(view, rig=rig)

    return spoil


def _late(frames: int) -> Spoil:
    return lambda view, rng: replace(
        view, right=np.concatenate([view.right[:1].repeat(frames, axis=0), view.right[:-frames]])
    )


def _exposed(gain: float) -> Spoil:
    return lambda view, rng: replace(
        view, right=np.clip(view.right * np.float32(gain), 0, 255).astype(np.uint8)
    )


def _blocked(share: float) -> Spoil:
    """Black from the left over a share of the width, from the middle of the film on."""

    def spoil(view: View, rng: np.random.Generator) -> View:
        right = view.right.copy()
        right[len(right) // 2 :, :, : round(share * right.shape[2])] = 0
        return replace(view, right=right)

    return spoil


def _glared(share: float) -> Spoil:
    """Soft white blobs over a share of the picture, elsewhere in every frame after the first."""

    def spoil(view: View, rng: np.random.Generator) -> View:
        right = view.right.astype(np.float32)
        height, width = right.shape[1:3]
        y, x = np.mgrid[:height, :width]
        for frame in right[1:]:
            covered = np.zeros((height, width), bool)
            while covered.mean() < share:
                radius = rng.uniform(0.02, 0.06) * width
                at = rng.uniform(0, width), rng.uniform(0, height)
                light = np.exp(-0.5 * ((x - at[0]) ** 2 + (y - at[1]) ** 2) / radius**2)
                frame += 400 * light[..., None].astype(np.float32)
                covered |= light > 0.3
        return replace(view, right=np.clip(right, 0, 255).astype(np.uint8))

    return spoil


def _point(root: Path, trouble: str, value: float, spoil: Spoil, count: int, seed: int) -> dict[str, Any]:
    dataset = Dataset(root)
    errors, spreads, offs, lags, refused = [], [], [], [], 0
    for k in range(min(count, len(dataset))):
        try:
            error, spread, off, lag = _followed(dataset[k], spoil, np.random.default_rng([seed, k]))
        except UserError:
            refused += 1
            continue
        errors.append(error)
        spreads.append(spread)
        offs.append(off)
        lags.append(lag)
    row = {"trouble": trouble, "value": value, "sequences": min(count, len(dataset)), "refused": refused}
    nothing: list[Floats] = [np.zeros(0)]
    return row | judged(np.concatenate(errors or nothing), np.concatenate(spreads or nothing), offs, lags)


def judged(error: Floats, spread: Floats, epipolar_px: list[float], lags: list[float]) -> dict[str, Any]:
    """Errors and stated deviations (n,) mm as a row; what was refused altogether is flagged."""
    if not len(error):
        return {"rms_mm": None, "stated_mm": None, "z68": None, "z95": None, "flagged": True, "silent": False}
    rms, stated = (float(np.sqrt(np.square(one).mean())) for one in (error, spread))
    off, lag = float(np.median(epipolar_px)), float(np.median(lags))
    z = np.abs(error) / spread
    flagged = stated >= check.NOISY_MM or off > check.OFF_ROWS_PX or lag > LATE
    return {
        "rms_mm": round(rms, 4),
        "stated_mm": round(stated, 4),
        "z68": round(float(np.quantile(z, 0.6827)), 2),
        "z95": round(float(np.quantile(z, 0.9545)), 2),
        "epipolar_px": round(off, 3),
        "lag": round(lag, 3),
        "flagged": bool(flagged),
        "silent": bool(rms > max(WRONG_MM, _SAYS * stated) and not flagged),
    }


def _followed(
    sequence: Sequence, spoil: Spoil, rng: np.random.Generator
) -> tuple[Floats, Floats, float, float]:
    """Errors of depth motion and stated deviations over seen tissue of all frames [mm]; epipolar px; lag."""
    left, tissue, tools = sequence["rgb"][:], sequence["tissue"][:], sequence["tool"][:]
    flow, trust = sequence["flow_recovered"][:], sequence["flow_confidence"][:]
    view = spoil(View(rig_of(sequence), sequence["rgb_right"][:]), rng)
    blocked = mask.hidden(left, tools)
    other = np.stack([mask.tool(picture) | mask.glare(picture) for picture in view.right])
    still = still_frames(flow, tissue)
    tracker = StereoTracker(view.rig, left[:still], view.right[:still], blocked[0], other[0], tissue)
    errors, spreads, lags = [], [], []
    for t in range(1, sequence.frames):
        moved = tracker.step(left[t], view.right[t], blocked[t], other[t], flow[t], trust[t])
        if np.percentile(np.abs(flow[t][tissue]), 98) > _MOVED_PX:
            lags.append(abs(tracker.lag))
        seen = tissue & ~tools[0] & sequence["visible"][t]
        errors.append((moved.motion - sequence["motion"][t])[seen, 2].astype(np.float64))
        spreads.append(moved.deviation[seen, 2].astype(np.float64))
    late = float(np.percentile(lags, 90)) if lags else 0.0
    return np.concatenate(errors), np.concatenate(spreads), tracker.rest.epipolar_px, late


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `stability.json` says: error and stated deviation, trouble by trouble."""
    panels = []
    for trouble in dict.fromkeys(row["trouble"] for row in found["rows"]):
        some = sorted(
            (row for row in found["rows"] if row["trouble"] == trouble and row["rms_mm"] is not None),
            key=lambda row: row["value"],
        )
        x = tuple(row["value"] for row in some)
        panels.append(
            charts.Panel(
                trouble,
                trouble,
                "depth motion [mm]",
                tuple(
                    charts.Curve(name, x, tuple(row[key] for row in some))
                    for name, key in (("error, rms", "rms_mm"), ("stated", "stated_mm"))
                ),
            )
        )
    return result_page.Page(
        "Two eyes under trouble", found, panels, [result_page.Section("Point by point", found["rows"])]
    )
