"""Where instruments are expected in the pictures: poses of a tracker (poses.csv), projected by meta.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bench.recording.meta import Tips
from synth.arrays import Floats, Mask
from synth.errors import UserError
from synth.flow.recording.frame_motion import Size
from synth.system import csv_table

_SHAFT_MM = 60.0  # length of an instrument, from its tip, that is expected
_PARTS = ("x", "y", "z", *(f"r{i}{j}" for i in "123" for j in "123"))


@dataclass(frozen=True)
class TipPrior:
    """Instruments of known poses, as a camera sees them."""

    poses: dict[int, list[Floats]]  # (4, 4) each, tool to tracker, by frame number; unknown ones left out
    projection: Floats  # (3, 4) from the tracker's axes to pixels
    axis: Floats | None  # (3,) from tip to hand, in the tool's axes; None: only tips are expected
    radius_px: float

    def expect(self, index: int, size: Size) -> Mask | None:
        """(H, W) where an instrument is expected in frame `index`; None if no pose is known there."""
        poses = self.poses.get(index)
        if not poses:
            return None
        canvas = np.zeros(size, np.uint8)
        for pose in poses:
            ends = np.array([pose[:3, 3]])
            if self.axis is not None:
                steps = np.linspace(0, _SHAFT_MM, 32)[:, None] * (pose[:3, :3] @ self.axis)
                ends = pose[:3, 3] + steps
            projected = self.projection @ np.column_stack([ends, np.ones(len(ends))]).T
            in_front = projected[2] > 0
            line = (projected[:2, in_front] / projected[2, in_front]).T
            line = line[(np.abs(line) < 10 * max(size)).all(axis=1)]
            if len(line):
                width = max(round(2 * self.radius_px), 1)
                corners = np.rint(line).astype(np.int32)
                cv2.polylines(canvas, [corners], False, 1, width)
                cv2.circle(canvas, corners[0].tolist(), width // 2, 1, -1)
        return canvas > 0


def read_tips(path: Path, tips: Tips, mm_per_px: float) -> TipPrior:
    """The poses in a poses.csv as `bench import` writes it. UserError: it is missing, or holds none."""
    names = csv_table.read_header(path)
    tools = [name.removesuffix("_r33") for name in names if name.endswith("_r33")]
    used_tools = [name for name in tools if all(f"{name}_{part}" in names for part in _PARTS)]
    if tips.names:
        lower_names = [name.lower() for name in tips.names]  # as headers are read
        if missing := set(lower_names) - set(used_tools):
            raise UserError(f"{path}: no pose {min(missing)}; there are {', '.join(used_tools) or 'none'}")
        used_tools = lower_names
    if not used_tools:
        raise UserError(f"{path}: holds no poses (columns NAME_x ... NAME_r33)")
    parts = [f"{name}_{part}" for name in used_tools for part in _PARTS]
    columns = csv_table.read_csv(path, ["frame", *parts])
    values = np.column_stack([columns[name] for name in parts]).reshape(-1, len(used_tools), len(_PARTS))
    poses = dict[int, list[Floats]]()
    for number, rows in zip(columns["frame"], values, strict=True):
        for row in rows[np.isfinite(rows).all(axis=1)] if np.isfinite(number) else ():
            pose = np.eye(4)
            pose[:3, 3], pose[:3, :3] = row[:3], row[3:].reshape(3, 3)
            poses.setdefault(int(number), []).append(pose)
    axis = None if tips.axis is None else np.asarray(tips.axis) / np.linalg.norm(tips.axis)
    return TipPrior(poses, np.array(tips.projection), axis, tips.radius_mm / mm_per_px)
