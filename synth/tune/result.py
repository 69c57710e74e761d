"""What tuning is asked for and what it finds: a budget, rows of a table, settings measured as a whole."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from synth.errors import UserError
from synth.job.schema import Job
from synth.tune.knobs import Knob, Level


@dataclass(frozen=True)
class Budget:
    """How much worse the force may be read."""

    share: float
    """By how much the error of the force may grow over that at full fidelity, as a part of the force: root
    mean square over frames, mean over sequences, none of which pays for another by reading better."""

    @classmethod
    def parse(cls, text: str) -> Budget:
        """`force 3%`. UserError for anything else."""
        found = re.fullmatch(r"\s*force\s+(\d+(?:\.\d+)?)\s*%\s*", text)
        if not found or not 0 < float(found[1]) < 100:
            raise UserError(f"--budget {text!r}: is written as 'force 3%', more than 0 and less than 100")
        return cls(float(found[1]) / 100)


@dataclass(frozen=True)
class Row:
    """What one level of one knob does by itself."""

    knob: str
    level: str
    error: float
    """What it takes of the budget; inf where a sequence cannot be carried out."""
    change: float
    """Of the error of the force over the finest level's, mean over sequences; below 0 it reads better."""
    saved: float
    """Part of a frame's cost at full fidelity that it saves."""
    why: str = ""
    """What stopped it."""


@dataclass(frozen=True)
class Joint:
    """A setting measured as a whole."""

    name: str
    levels: tuple[str, ...]
    promised: float
    """Error by adding up; NaN where nothing was promised."""
    errors: tuple[float, ...]
    """By sequence, what counts: the larger of how far the label moves and of how much more than at full
    fidelity the force read from the recovered displacement is off."""
    totals: tuple[float, ...]
    """By sequence, how far the force read from the recovered displacement is off."""
    apart: tuple[float, ...]
    """By sequence, how far it is from what is read at full fidelity, frame by frame: grain that differs
    counts here, though neither picture is the better one."""
    cost: float
    """CPU-s a frame: physics, scene, rendering, flow; not the writing of the store."""

    @property
    def error(self) -> float:
        return float(np.mean(self.errors))

    @property
    def total(self) -> float:
        return float(np.mean(self.totals))


@dataclass(frozen=True)
class Tuned:
    """The answer."""

    job: Job
    budget: Budget
    knobs: tuple[Knob, ...]
    chosen: tuple[Level, ...]
    rows: tuple[Row, ...]
    full: Joint
    own: Joint
    """The job as it was."""
    tried: tuple[Joint, ...]
    best: Joint
    """Of those the answer."""
    kinds: tuple[str, ...]
    """Gestures of the probe sequences."""
