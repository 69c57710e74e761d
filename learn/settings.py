"""Settings of a training run, and their presets."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, model_validator

from learn.data.clips import Input, has_depth
from learn.data.grid import Grid
from learn.loss import Loss
from learn.network.d2fnet import Architecture
from synth.errors import UserError
from synth.job.types import NonNegative, Positive, Section

Count = Annotated[int, Field(ge=0)]
AtLeastOne = Annotated[int, Field(ge=1)]
S = TypeVar("S", bound=Section)


class TrainingSettings(Section):
    """One training run: same settings, same data, same weights (bit for bit, on one CPU)."""

    size: Annotated[int, Field(ge=16, le=1024, multiple_of=16)] = 256
    """Cells along the grid's edge."""
    extent_mm: Annotated[Positive, Field(le=1e4)] = 36.0
    """Width of the grid [mm]."""
    arch: Architecture = Architecture()
    loss: Loss = "antighost"
    input: Input = "ideal"
    """Displacement to train on. `mixed`: each frame is drawn ideal or recovered, with odds that move from all
    ideal to all recovered over the first half of the run. `motion`, `motion-ideal`, `motion-mixed`: stereo
    motion, recovered, true or mixed; they need `arch.depth`."""
    epochs: AtLeastOne = 50
    batch: AtLeastOne = 8
    learning_rate: Positive = 5e-4
    schedule: Literal["plateau", "cosine"] = "plateau"
    """`plateau`: the learning rate is halved when the score stalls, as published; `cosine`: a warm-up over a
    twentieth of the run, then half a cosine to zero, for runs too short for a plateau."""
    surface_motion_mm: NonNegative = 0.0
    """Standard deviation of a random motion of the whole surface, without force, that is added to half of the
    frames: along the optical axis (with `arch.depth`), and a third of it across. It shifts, tilts and bulges,
    as breathing, heartbeat and a pushed table do."""
    frames: Count = 0
    """Frames per sequence and epoch, drawn each epoch; 0: all."""
    epoch_frames: Count = 0
    """Most frames of an epoch, drawn each epoch; 0: no limit."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    seed: Count = 0

    @model_validator(mode="after")
    def _goes_together(self) -> TrainingSettings:
        if self.arch.depth != has_depth(self.input):
            raise ValueError(f"input {self.input!r} needs arch.depth {str(not self.arch.depth).lower()}")
        halved = self.arch.stem * 2**self.arch.levels
        if self.size % halved:
            raise ValueError(
                f"input size {self.size} is not divisible by {halved} "
                f"(stem {self.arch.stem}, {self.arch.levels} levels)"
            )
        return self

    @property
    def grid(self) -> Grid:
        return Grid(self.size, self.extent_mm)


def replace(settings: S, **changes: Any) -> S:
    """Settings or an architecture with replaced values. Raises pydantic's ValidationError."""
    return type(settings).model_validate(dict(settings) | changes)


_SHORT: dict[str, Any] = {"epochs": 24, "schedule": "cosine", "frames": 12, "epoch_frames": 4000}
# Stereo also measures the lift of the whole surface: without surface motion a breath was taken for a press.
_STEREO: dict[str, Any] = {
    "input": "motion-mixed",
    "loss": "mse-frame",
    "surface_motion_mm": 0.5,
    "learning_rate": 1e-3,
}
_STEREO_ARCH = Architecture(width=16, stem=4, confidence=True, depth=True, dropout=0.05, relative=True)
PRESETS: dict[str, TrainingSettings] = {
    # Seconds to minutes: for tests.
    "tiny": TrainingSettings(
        size=64,
        arch=Architecture(width=16, stem=2, levels=3, dropout=0.0),
        epochs=20,
        # In so short a run the losses against off-target force only lower all forces (docs/results/learn).
        loss="mse",
        learning_rate=2e-3,
        schedule="cosine",
    ),
    # At most 20 minutes on one core, for any number of sequences.
    "cpu": TrainingSettings(
        size=128,
        # A stem of 2 has the same error at twice the time, in training too (docs/results/learn/pareto).
        # Magnitudes: with vectors this loss has an R² 0.10 below squared error's (docs/results/learn).
        arch=Architecture(width=16, stem=4, output="magnitude", dropout=0.05),
        loss="off-target",
        learning_rate=1e-3,
        **_SHORT,
    ),
    # d2fnet-s: 256², 10 ms a frame on one core (12 with a fourth halving).
    "live": TrainingSettings(
        arch=Architecture(width=16, stem=4, levels=3, output="magnitude", dropout=0.05),
        loss="off-target",
        learning_rate=1e-3,
    ),
    # `cpu` and `live` for stereo motion. Force along the optical axis is then observable, so their output is
    # vectors, for which squared error with R² by frame is best.
    "stereo": TrainingSettings(size=128, arch=_STEREO_ARCH, **_SHORT, **_STEREO),
    "stereo-live": TrainingSettings(arch=replace(_STEREO_ARCH, levels=3), **_STEREO),
    # The network, loss and schedule of Heraoui et al., on our targets.
    "paper": TrainingSettings(arch=Architecture(width=32, stem=1, dropout=0.1)),
}


def preset(name: str, **changes: Any) -> TrainingSettings:
    """A preset with some settings replaced. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"unknown preset {name!r}: one of {', '.join(PRESETS)}")
    return replace(PRESETS[name], **changes)


def as_changes(words: Iterable[str]) -> tuple[dict[str, str], list[str]]:
    """A command line's `key=value`, `--key=value` and `--key value` as `{key: value}`, and its other words.

    The last of a key counts. `input` also sets the `arch.depth` that it needs, unless that is given. Raises
    UserError for a `--key` without a value.
    """
    changes, others, rest = dict[str, str](), list[str](), iter(words)
    for word in rest:
        key, equals, value = word.removeprefix("--").partition("=")
        if not equals and not word.startswith("--"):
            others.append(word)
            continue
        if not equals and (value := next(rest, "--")).startswith("--"):
            raise UserError(f"{word}: needs a value")
        changes[key.strip()] = value
    if "input" in changes:
        changes.setdefault("arch.depth", str(has_depth(changes["input"])))
    return changes, others
