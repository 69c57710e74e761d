"""What one sequence is: every number drawn for it, a function of (job, index) only."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from synth.fem import multi_instrument
from synth.fem.material import Tissue
from synth.fem.pulse import Pulse
from synth.fem.tool import Gesture
from synth.job.schema import Job
from synth.render.anatomy.surface import Relief
from synth.render.camera.camera import View
from synth.render.camera.sway import Sway
from synth.render.scene import Look

# First element of the spawn key: anatomies are shared between sequences, everything else is not.
_ANATOMY, _SEQUENCE = 0, 1
_TISSUE, _GESTURE, _LOOK, _VIEW, _NOISE, _FURTHER, _LABELS, _SWAY, _PULSE = range(9)


@dataclass(frozen=True)
class Scenario:
    """One sequence before anything is computed. JSON-ready through `as_dict`."""

    index: int
    """Position in the dataset."""
    anatomy: int
    """Which anatomy; sequences that share it must never be split between training and test."""
    family: str
    """Appearance family."""
    relief: Relief
    """Shape and vessels of the anatomy, with its own seed."""
    tissue: Tissue
    gesture: Gesture
    """What the first instrument does."""
    further: tuple[Gesture, ...]
    """What the other instruments do at the same time."""
    look: Look
    view: View
    sway: Sway
    pulse: Pulse | None
    """None where only tools move the tissue."""

    @property
    def gestures(self) -> tuple[Gesture, ...]:
        """One an instrument."""
        return (self.gesture, *self.further)

    def as_dict(self) -> dict[str, Any]:
        described = asdict(self)
        described["tissue"]["averaged"] = True  # as when elements could do without
        return described


def draw(job: Job, index: int) -> Scenario:
    """Draws sequence `index` of `job`; independent of how many others there are and of their order."""
    anatomy = index % (job.anatomy.variety or job.sequences)
    family = job.appearance.families[index % len(job.appearance.families)]
    opening = job.anatomy.craniotomy
    tissue = Tissue.draw(job.fem, _generator(job, _SEQUENCE, index, _TISSUE))
    gesture, *further = multi_instrument.draw_crew(
        job.fem,
        opening,
        tissue,
        _generator(job, _SEQUENCE, index, _GESTURE),
        _generator(job, _SEQUENCE, index, _FURTHER),
    )
    return Scenario(
        index=index,
        anatomy=anatomy,
        family=family,
        relief=Relief.draw(job.anatomy, _generator(job, _ANATOMY, anatomy, 0)),
        tissue=tissue,
        gesture=gesture,
        further=tuple(further),
        look=Look.draw(job, family, _generator(job, _SEQUENCE, index, _LOOK)),
        view=View.draw(job.render, _generator(job, _SEQUENCE, index, _VIEW)),
        sway=Sway.draw(job.render, _generator(job, _SEQUENCE, index, _SWAY)),
        pulse=Pulse.draw(job.fem.pulse, _generator(job, _SEQUENCE, index, _PULSE)),
    )


def frame_seeds(job: Job, index: int) -> list[int]:
    """One seed a frame, for light paths and sensor noise: a fixed one would leave screen-fixed noise."""
    state = _sequence(job, _SEQUENCE, index, _NOISE).generate_state(job.frames)
    return [int(seed) for seed in state]


def label_rng(job: Job, index: int) -> np.random.Generator:
    """Random numbers for the noise of the published labels."""
    return _generator(job, _SEQUENCE, index, _LABELS)


def _sequence(job: Job, *key: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(job.seed, spawn_key=key)


def _generator(job: Job, *key: int) -> np.random.Generator:
    return np.random.default_rng(_sequence(job, *key))
