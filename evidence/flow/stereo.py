"""Motion in three dimensions from stereo, as datasets store it: error, bias, z-scores and cost."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evidence import report, result_status
from evidence.study import STEREO_MOTION, Study
from synth.arrays import Array, Mask
from synth.dataset.store import Dataset, Sequence

_EVERY = 7  # one in so many visible pixels is measured
_CONTACT, _DEEP_MM = 0.05, 0.1  # pressed: load above this share of its peak, and moved this far in depth


Sample = tuple[Array, Array, Array, Mask]
"""Visible tissue of one frame: true and recovered motion, deviation, (n, 3) mm; whether in contact (n,)."""


def measure(data: list[Path], count: int = 100) -> dict[str, Any]:
    """Depth motion from stereo by resolution, on `count` sequences of datasets that were not tuned on."""
    rows = []
    for root in data:
        sequences = list(Dataset(root))[:count]
        height, width = sequences[0].size
        flow_s, stereo_s = (
            sum(sequence.attrs["timings"][stage]["cpu_s"] for sequence in sequences)
            for stage in ("flow", "stereo")
        )
        rows.append(
            {"data": root.name, "size": f"{width} x {height}", "sequences": len(sequences)}
            | figures([sample for sequence in sequences for sample in _samples(sequence)])
            | {"cost_ratio": float((flow_s + stereo_s) / flow_s)}
        )
    return {"data": result_status.data(*data), "rows": rows}


def figures(samples: list[Sample]) -> dict[str, float]:
    """Errors in mm, bias as a share, quantiles of |error| / deviation in depth and across the view."""
    true, recovered, deviation, pressed = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    z = np.abs(recovered - true) / deviation
    in_contact = pressed & (np.abs(true[:, 2]) > _DEEP_MM)
    bias = (
        1 - (true[in_contact, 2] * recovered[in_contact, 2]).sum() / (true[in_contact, 2] ** 2).sum()
        if in_contact.any()
        else np.nan
    )
    return {
        "depth_rms_mm": _rms(recovered[:, 2] - true[:, 2]),
        "signal_rms_mm": _rms(true[:, 2]),
        "pressed_bias": float(bias),
        "depth_z68": float(np.quantile(z[:, 2], 0.6827)),
        "depth_z95": float(np.quantile(z[:, 2], 0.9545)),
        "across_z68": float(np.quantile(z[:, :2], 0.6827)),
        "across_z95": float(np.quantile(z[:, :2], 0.9545)),
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _samples(sequence: Sequence) -> list[Sample]:
    """Samples of all frames but the rest frame."""
    samples = []
    for t in range(1, sequence.frames):
        visible = sequence["tissue"][:] & ~sequence["tool"][0] & sequence["visible"][t]
        load = np.linalg.norm(sequence["traction"][t], axis=-1)
        motion = (sequence[name][t] for name in ("motion", "motion_recovered", "motion_deviation"))
        fields = *motion, load > _CONTACT * max(load.max(), 1e-9)
        true, recovered, deviation, pressed = (np.asarray(field)[visible][::_EVERY] for field in fields)
        samples.append((true, recovered, deviation, pressed))
    return samples


_TARGETS = (
    ("depth_rms_mm", "depth motion, RMS error over visible tissue", {"640 x 480": 0.04, "320 x 240": 0.10}),
    ("pressed_bias", "its bias at the contact", {"640 x 480": 0.05}),
    ("cost_ratio", "CPU time relative to monocular flow", {"640 x 480": 2.2, "320 x 240": 2.2}),
)


def page(data: Mapping[str, Any]) -> report.Page:
    """Draws `stereo.json`: values relative to their targets, z-scores, every row."""
    shares: dict[str, list[float]] = {}
    scores: dict[str, list[float]] = {}
    for row in data["rows"]:
        for key, label, limits in _TARGETS:
            if row["size"] in limits:
                shares[f"{label}: {row['data']}"] = [abs(row[key]) / limits[row["size"]]]
        for part in ("depth", "across"):
            scores[f"{part}, 68%: {row['data']}"] = [row[f"{part}_z68"]]
            scores[f"{part}, 95%: {row['data']}"] = [row[f"{part}_z95"] / 2]
    calibrated = "Calibrated at 1", "quantile of |error| / deviation, over 1 and 2", scores
    chart = report.interval_charts(("Target reached if at most 1", "measured / target", shares), calibrated)
    met = sum(value <= 1 for (value,) in shares.values())
    words = [f"**{met} of {len(shares)} targets are reached.** *z*: quantiles of |error| / deviation."]
    sections = [report.Section("", data["rows"])]
    return report.Page("Stereo: motion in three dimensions", data, words, sections, chart)


STUDY = Study(
    measure,
    "flow/stereo/stereo.json",
    page,
    ("{stereo-640} {stereo-320}",),
    needs=STEREO_MOTION,
)
