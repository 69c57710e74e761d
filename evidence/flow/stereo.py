"""`bench experiment stereo`: motion in three dimensions from two eyes, asked against measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import cv2
import numpy as np
import torch
import typer
from numpy.typing import NDArray

from bench.output import charts, result_page
from evidence.measuring import measuring
from synth.checks import optics, stereo
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.flow import mask
from synth.flow.stereo import rest
from synth.flow.stereo.rig import Eye, Rig
from synth.flow.stereo.track import StereoTracker, still_frames
from synth.flow.track import Track, track

Floats = NDArray[np.floating]
Found = TypeVar("Found")

_EVERY = 7  # of the seen pixels one in so many is measured
_CONTACT, _DEEP_MM = 0.05, 0.1  # pressed: load above this share of its peak, and moved so far in depth
_OFF_PX = 2.0


@dataclass(frozen=True)
class Sample:
    """Seen tissue of one frame, by one way of recovering it; (n, 3) mm each."""

    tier: str
    true: Floats
    found: Floats
    deviation: Floats
    mono: Floats
    """(n, 2) mm, error of the left eye's flow alone."""
    pressed: NDArray[np.bool_]
    """(n,) under the contact."""


@measuring(
    "data-640 data-320 --pair motorcycle",
    out="docs/results/flow/stereo",
    file="stereo.json",
    page=lambda found, folder: result_page.write(drawn(found), folder),
    text="index.html",
)
def experiment(
    data: Annotated[list[Path], typer.Argument(help="Stereo datasets, of seeds that nothing was chosen on.")],
    pair: Annotated[
        Path | None,
        typer.Option(
            help="Folder with left.png, right.png and disp.npz (disparity) of a real rectified pair."
        ),
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="Sequences of each dataset.")] = 100,
) -> dict[str, Any]:
    """Depth motion from two eyes: error, bias, z-scores and cost, by resolution; rest disparity."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = []
    for root in data:
        dataset = Dataset(root)
        samples, costs, offs = [], [], []
        for k in range(min(count, len(dataset))):
            found, cost, off = _measured(dataset[k])
            samples += found
            costs.append(cost)
            offs.append(off)
        height, width = dataset[0].size
        for tier in ("joint", "fused"):
            ours = [one for one in samples if one.tier == tier]
            ratio = sum(c[tier] for c in costs) / sum(c["flow"] for c in costs)
            rows.append(
                {"data": root.name, "size": f"{width} x {height}", "way": tier, "sequences": len(costs)}
                | figures(ours)
                | {"cost_ratio": round(ratio, 2), "epipolar_px": round(float(np.median(offs)), 3)}
            )
    return {"rows": rows} | ({} if pair is None else {"pair": real_pair(pair)})


def figures(samples: list[Sample]) -> dict[str, float]:
    """What samples of one way come to: errors in mm, bias as a share, quantiles of |error| / deviation."""
    true, found, deviation, mono, pressed = (
        np.concatenate([getattr(one, name) for one in samples])
        for name in ("true", "found", "deviation", "mono", "pressed")
    )
    error = found - true
    z = np.abs(error) / deviation
    here = pressed & (np.abs(true[:, 2]) > _DEEP_MM)
    bias = 1 - (true[here, 2] * found[here, 2]).sum() / (true[here, 2] ** 2).sum() if here.any() else np.nan
    across = np.sqrt(np.square(error[:, :2]).mean())
    return {
        "depth_rms_mm": round(float(np.sqrt(np.square(error[:, 2]).mean())), 4),
        "signal_rms_mm": round(float(np.sqrt(np.square(true[:, 2]).mean())), 4),
        "largest_motion_mm": round(float(np.linalg.norm(true, axis=1).max()), 2),
        "pressed_bias": round(float(bias), 4),
        "across_to_mono": round(float(across / np.sqrt(np.square(mono).mean())), 3),
        "depth_z68": round(float(np.quantile(z[:, 2], 0.6827)), 2),
        "depth_z95": round(float(np.quantile(z[:, 2], 0.9545)), 2),
        "across_z68": round(float(np.quantile(z[:, :2], 0.6827)), 2),
        "across_z95": round(float(np.quantile(z[:, :2], 0.9545)), 2),
    }


def real_pair(folder: Path) -> list[dict[str, Any]]:
    """Pixels off by more than 2 px on a real rectified pair whose disparity is known, and at its edges."""
    left, right = (_grey(folder / f"{eye}.png") for eye in ("left", "right"))
    archive = np.load(folder / "disp.npz")
    truth = archive[archive.files[0]].astype(np.float32)
    known = np.isfinite(truth) & (truth > 0)
    every = np.ones(truth.shape, bool)
    steps = cv2.morphologyEx(np.where(known, truth, 0), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 3 * _OFF_PX
    edge = cv2.dilate(steps.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    rows = []
    for name, refine in (("OpenCV SGBM, holes filled", False), ("ours", True)):
        found = rest.match(left, right, every, every, (0, int(np.nanmax(truth[known])) + 8), refine=refine)
        off = np.abs(found.disparity - truth)
        if not refine:
            alone = (off > _OFF_PX) | ~found.found
            rows.append({"method": "OpenCV SGBM, holes count"} | _shares(alone, off, known, edge))
        rows.append({"method": name} | _shares(off > _OFF_PX, off, known, edge))
    return rows


def _grey(path: Path) -> NDArray[np.float32]:
    picture = cv2.imread(str(path))
    if picture is None:
        raise UserError(f"{path}: not a readable picture")
    return np.asarray(picture[..., ::-1] @ np.array([0.2, 0.6, 0.2], np.float32), np.float32)


def _shares(bad: NDArray[np.bool_], off: Floats, known: NDArray[np.bool_], edge: NDArray[np.bool_]) -> Any:
    return {
        "off_by_2px": round(float(bad[known].mean()), 4),
        "off_by_2px_at_edges": round(float(bad[known & edge].mean()), 4),
        "median_px": round(float(np.median(off[known])), 3),
    }


def rig_of(sequence: Sequence) -> Rig:
    """The pair of lenses that took a stereo sequence."""
    left, right = optics.camera_of(sequence), stereo.right_of(sequence)
    eyes = Eye(left.K, left.distortion), Eye(right.K, right.distortion)
    return Rig(*eyes, np.eye(3), right.translation - left.translation, left.size)


def _measured(sequence: Sequence) -> tuple[list[Sample], dict[str, float], float]:
    """Samples of all frames by each way, CPU time [s] by way, and the rest pair's distance from its rows."""
    film = sequence["rgb"][:], sequence["rgb_right"][:]
    tissue, tools = sequence["tissue"][:], sequence["tool"][:]
    # Under the tool nothing is known of the right eye but its picture: masks as the picture gives them.
    found = np.stack([mask.tool(picture) for picture in film[1]])
    blocked = mask.hidden(film[0], tools), mask.hidden(film[1], found)
    left, flow_s = _timed(lambda: track("tvl1", film[0], blocked[0], tissue))
    right, right_s = _timed(lambda: track("tvl1", film[1], blocked[1], np.ones_like(tissue)))
    still = still_frames(left.flow, tissue)

    def begin() -> StereoTracker:
        eyes = film[0][:still], film[1][:still]
        return StereoTracker(rig_of(sequence), *eyes, blocked[0][0], blocked[1][0], tissue)

    tracker, start_s = _timed(begin)
    cost = {"flow": flow_s, "joint": flow_s + start_s, "fused": flow_s + right_s + start_s}
    samples = []
    for t in range(1, sequence.frames):
        for tier, moved, spent in _both(tracker, film, blocked, left, right, t):
            cost[tier] += spent
            samples.append(_sample(sequence, t, tier, moved, left, tissue & ~tools[0]))
    return samples, cost, tracker.rest.epipolar_px


def _both(
    tracker: StereoTracker,
    film: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    blocked: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    left: Track,
    right: Track,
    t: int,
) -> Iterator[tuple[str, Any, float]]:
    seen = left.flow[t], left.confidence[t]
    eyes = film[0][t], film[1][t], blocked[0][t], blocked[1][t]
    yield "joint", *_timed(lambda: tracker.step(*eyes, *seen))
    yield "fused", *_timed(lambda: tracker.fuse(*seen, right.flow[t], right.confidence[t]))


def _sample(
    sequence: Sequence, t: int, tier: str, moved: Any, left: Track, tissue: NDArray[np.bool_]
) -> Sample:
    seen = tissue & sequence["visible"][t]
    load = np.linalg.norm(sequence["traction"][t], axis=-1)
    scale = sequence.attrs["scale_mm_per_px"]
    return Sample(
        tier,
        sequence["motion"][t][seen][::_EVERY],
        moved.motion[seen][::_EVERY],
        moved.deviation[seen][::_EVERY],
        scale * (left.flow[t] - sequence["flow"][t])[seen][::_EVERY],
        (load > _CONTACT * max(float(load.max()), 1e-9))[seen][::_EVERY],
    )


def _timed(work: Callable[[], Found]) -> tuple[Found, float]:
    begun = time.process_time()
    return work(), time.process_time() - begun


_ASKED = (
    ("depth_rms_mm", "Depth motion, rms over seen tissue [mm]", {"640 x 480": 0.04, "320 x 240": 0.10}),
    ("pressed_bias", "Its bias under pressed contact (size)", {"640 x 480": 0.05}),
    ("across_to_mono", "In-plane error to the monocular one", {"640 x 480": 1.0, "320 x 240": 1.0}),
    ("cost_ratio", "Cost to the monocular one", {"640 x 480": 2.2, "320 x 240": 2.2}),
)


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `stereo.json` says: what was asked as a part of what was allowed, z-scores, every row."""
    shares, scores = {}, {}
    for row in found["rows"]:
        who = f"{row['way']}, {row['data']}"
        for key, words, limits in _ASKED:
            if row["size"] in limits:
                shares[f"{words}: {who}"] = abs(row[key]) / limits[row["size"]]
        for part in ("depth", "across"):
            scores[f"{part}, 68%: {who}"] = row[f"{part}_z68"]
            scores[f"{part}, 95%: {who}"] = row[f"{part}_z95"] / 2
    shown = [
        charts.Chart("Reached where at most 1", "measured / asked", charts.bars(shares)),
        charts.Chart(
            "Calibrated where 0.9 to 1.1",
            "quantile of |error| / deviation, over 1 and 2",
            charts.bars(scores),
        ),
    ]
    sections = [result_page.Section("By size and way", found["rows"])]
    if "pair" in found:
        sections.append(result_page.Section("Rest disparity of a real pair", found["pair"]))
    return result_page.Page("Two eyes: motion in three dimensions", found, shown, sections)
