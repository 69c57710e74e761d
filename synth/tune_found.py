"""What tuning is asked for and what it finds: a budget, rows of a table, settings measured as a whole."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from synth.errors import UserError
from synth.job import Job
from synth.tune_knobs import Knob, Level


@dataclass(frozen=True)
class Budget:
    """How much the force may move."""

    share: float
    """Mean over sequences of each one's root mean square over frames, as a part of its force."""

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
    """Of the force, against the finest level; inf where a sequence cannot be carried out."""
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
    """Of the force by sequence: the larger of what the label and the recovered displacement say."""
    cost: float
    """CPU-s a frame: physics, scene, rendering, flow; not the writing of the store."""

    @property
    def error(self) -> float:
        return float(np.mean(self.errors))


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
    """The last one is the answer."""
    kinds: tuple[str, ...]
    """Gestures of the probe sequences."""

    @property
    def best(self) -> Joint:
        return self.tried[-1]
