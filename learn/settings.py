"""Everything that decides a training run, and the presets."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, model_validator

from learn.data.clips import Input, Target, has_depth
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
    """Displacement to train on. `mixed`: each frame is ideal or recovered by a draw whose odds move from
    all ideal to all recovered over the first half of the run. `motion`, `motion-ideal`, `motion-mixed`: in
    three dimensions, as two eyes recover it, true, or both; they go with `arch.depth`."""
    target: Target = "density"
    epochs: AtLeastOne = 50
    batch: AtLeastOne = 8
    learning_rate: Positive = 5e-4
    schedule: Literal["plateau", "cosine"] = "plateau"
    """`plateau`: halved when the score stalls (the paper's); `cosine`: a warm-up over a twentieth of the run,
    then down to zero by a half cosine, for runs too short to wait for a plateau."""
    surface_motion_mm: NonNegative = 0.0
    """Standard deviation of a motion of the whole surface that half of the frames get on top, drawn anew:
    along the view (with `arch.depth`), a third of it across. It is even, tilted and bulged, as breath,
    heartbeat and a table that was pushed make it, and carries no force."""
    frames: Count = 0
    """Frames a sequence gives an epoch, drawn anew each epoch; 0 takes all."""
    epoch_frames: Count = 0
    """Most frames that an epoch has, drawn anew each epoch, so that more sequences take no longer; 0 sets no
    limit."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    seed: Count = 0

    @model_validator(mode="after")
    def _goes_together(self) -> TrainingSettings:
        if self.target == "intensity" and self.arch.output != "magnitude":
            raise ValueError("target 'intensity' has no direction: it needs output 'magnitude'")
        if self.arch.depth != has_depth(self.input):
            raise ValueError(f"input {self.input!r} goes with arch.depth {str(not self.arch.depth).lower()}")
        halved = self.arch.stem * 2**self.arch.levels
        if self.size % halved:
            raise ValueError(
                f"input size {self.size} does not divide by {halved} "
                f"(stem {self.arch.stem}, {self.arch.levels} levels)"
            )
        return self

    @property
    def grid(self) -> Grid:
        return Grid(self.size, self.extent_mm)


def replace(settings: S, **changes: Any) -> S:
    """Settings or an architecture with some values replaced, and checked anew.

    Raises pydantic's ValidationError for a value that can't be: these come from code, not from a person.
    """
    return type(settings).model_validate(dict(settings) | changes)


_SHORT: dict[str, Any] = {
    "epochs": 24,
    "schedule": "cosine",
    "frames": 12,
    "epoch_frames": 4000,
}
# What lifts the whole surface a second eye sees as well: without sway a breath was read as a press.
_STEREO: dict[str, Any] = {
    "input": "motion-mixed",
    "loss": "mse-frame",
    "surface_motion_mm": 0.5,
    "learning_rate": 1e-3,
}
_STEREO_ARCH = Architecture(width=16, stem=4, confidence=True, depth=True, dropout=0.05, relative=True)
PRESETS: dict[str, TrainingSettings] = {
    # Seconds to minutes: shows that everything joins up, not how good it can be.
    "tiny": TrainingSettings(
        size=64,
        arch=Architecture(width=16, stem=2, levels=3, dropout=0.0),
        epochs=20,
        # In a run this short the anti-ghost loss has only learnt to say little (docs/results/learn).
        loss="mse",
        learning_rate=2e-3,
        schedule="cosine",
    ),
    # At most 20 minutes on one core, with however many sequences: tells good choices from bad.
    "cpu": TrainingSettings(
        size=128,
        # A stem of 2 errs no less and takes twice the time, in training too (docs/results/learn/pareto).
        # Magnitudes: on vectors this loss leaves 0.10 less of R² than squared error (docs/results/learn).
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
    # `cpu` and `live` given motion in three dimensions. Force is then seen along the view as well, so they
    # answer with vectors, and squared error, a frame's own too, is what serves those.
    "stereo": TrainingSettings(size=128, arch=_STEREO_ARCH, **_SHORT, **_STEREO),
    "stereo-live": TrainingSettings(arch=replace(_STEREO_ARCH, levels=3), **_STEREO),
    # The network, loss weights and schedule of Heraoui et al., on our targets.
    "paper": TrainingSettings(arch=Architecture(width=32, stem=1, dropout=0.1)),
}


def preset(name: str, **changes: Any) -> TrainingSettings:
    """A preset with some settings replaced. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"unknown preset {name!r}: one of {', '.join(PRESETS)}")
    return replace(PRESETS[name], **changes)


def as_changes(words: Iterable[str]) -> tuple[dict[str, str], list[str]]:
    """A command line's `key=value`, `--key=value` and `--key value` as `{key: value}`, and its other words.

    The last of a key counts. An `input` brings the `arch.depth` that goes with it, unless that is given too.

    Raises:
        UserError: a `--key` without a value.
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
