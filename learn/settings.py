"""Everything that decides a training run, and the presets."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from learn.data.clips import INPUTS, Input, Target
from learn.data.grid import Grid
from learn.loss import GHOSTLESS, Objective
from learn.network.d2fnet import Architecture
from synth.errors import UserError


@dataclass(frozen=True)
class Settings:
    """One training run: same settings, same data, same weights (bit for bit, on one CPU)."""

    size: int = 256
    """Cells along the grid's edge."""
    extent_mm: float = 36.0
    """Width of the grid [mm]."""
    arch: Architecture = field(default_factory=Architecture)
    objective: Objective = field(default_factory=Objective)
    input: Input = "ideal"
    """Displacement to train on. `mixed`: each frame is ideal or recovered by a draw whose odds move from
    all ideal to all recovered over the first half of the run."""
    target: Target = "density"
    epochs: int = 50
    batch: int = 8
    learning_rate: float = 5e-4
    weight_decay: float = 1e-5
    schedule: Literal["plateau", "cosine"] = "plateau"
    """`plateau`: halved when the score stalls (the paper's); `cosine`: a warm-up over a twentieth of the run,
    then down to zero by a half cosine, for runs too short to wait for a plateau."""
    patience: int = 5
    """`plateau`: epochs without a better score after which the learning rate is halved."""
    stop: int = 0
    """Epochs without a better score after which training ends; 0 never."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    augment: bool = True
    """Quarter turns and mirrors of the grid, vectors turned with it."""
    frames: int = 0
    """Frames a sequence gives an epoch, drawn anew each epoch; 0 takes all."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    channels_last: bool = False
    resident: Literal["auto", "yes", "no"] = "auto"
    """Whether all frames are held by the device and turned there: `auto` on a GPU whose memory is enough."""
    compile: bool = False
    """Whether torch.compile takes the network: worth its minute on a GPU; needs a C++ compiler on a CPU."""
    deterministic: bool = False
    """Whether operations without a deterministic form are refused. On one CPU the others give equal bits too;
    on a GPU set CUBLAS_WORKSPACE_CONFIG=:4096:8 beside it."""
    folds: int = 5
    fold: int = 0
    held_out_family: str | None = None
    share_anatomy: bool = False
    """Whether one brain's sequences may be on several sides of the split, for a dataset of a single brain."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.input not in INPUTS:
            raise UserError(f"unknown input {self.input!r}: one of {', '.join(INPUTS)}")
        if self.target not in ("density", "intensity"):
            raise UserError(f"unknown target {self.target!r}: density or intensity")
        if self.target == "intensity" and self.arch.output != "magnitude":
            raise UserError("target 'intensity' has no direction: it needs output 'magnitude'")
        if self.schedule not in ("plateau", "cosine"):
            raise UserError(f"unknown schedule {self.schedule!r}: plateau or cosine")
        if self.resident not in ("auto", "yes", "no"):
            raise UserError(f"unknown resident {self.resident!r}: auto, yes or no")
        for name in ("epochs", "batch", "learning_rate", "clip"):
            if not getattr(self, name) > 0:
                raise UserError(f"{name} {getattr(self, name)}: must be positive")
        self.arch.check(self.size)

    @property
    def grid(self) -> Grid:
        return Grid(self.size, self.extent_mm)

    def as_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def from_dict(tree: dict[str, Any]) -> Settings:
    """The inverse of `as_dict`. Raises TypeError or UserError for anything else."""
    tree = dict(tree)
    arch = dict(tree.pop("arch"))
    arch["bounds"] = tuple(arch["bounds"])
    objective = dict(tree.pop("objective"))
    if "ramp" in objective:
        objective["ramp"] = tuple(objective["ramp"])
    return Settings(arch=Architecture(**arch), objective=Objective(**objective), **tree)


PRESETS: dict[str, Settings] = {
    # Seconds to minutes: shows that everything joins up, not how good it can be.
    "tiny": Settings(
        size=64,
        arch=Architecture(width=16, stem=2, levels=3, dropout=0.0),
        epochs=20,
        # In a run this short the anti-ghost loss has only learnt to say little (docs/results/learn).
        objective=Objective(kind="mse"),
        learning_rate=2e-3,
        schedule="cosine",
        channels_last=True,
        batch=8,
    ),
    # At most 20 minutes on one core with a few dozen sequences: tells good choices from bad.
    "cpu": Settings(
        size=128,
        # A stem of 2 errs no less and takes twice the time, in training too (docs/results/learn/pareto).
        # Magnitudes: on vectors this loss leaves 0.10 less of R² than squared error (docs/results/learn).
        arch=Architecture(width=16, stem=4, levels=4, output="magnitude", dropout=0.05),
        epochs=24,
        objective=GHOSTLESS,
        learning_rate=1e-3,
        schedule="cosine",
        channels_last=True,
        batch=8,
        frames=12,
    ),
    # d2fnet-s: 256², 10 ms a frame on one core (12 with a fourth halving).
    "live": Settings(
        size=256,
        arch=Architecture(width=16, stem=4, levels=3, output="magnitude", dropout=0.05),
        objective=GHOSTLESS,
        learning_rate=1e-3,
    ),
    # The network, loss weights and schedule of Heraoui et al., on our targets.
    "paper": Settings(arch=Architecture(width=32, stem=1, dropout=0.1)),
}


def override(settings: Settings, changes: Iterable[str]) -> Settings:
    """Settings with `key=value` or `arch.key=value` replaced, values read as the field's own type.

    Raises UserError for an unknown key (with the nearest one) or a value of another type.
    """
    top: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {"arch": {}, "objective": {}}
    for change in changes:
        key, _, text = change.partition("=")
        section, dot, name = key.rpartition(".")
        owner = getattr(settings, section, None) if dot and section in inner else settings
        if (dot and section not in inner) or not hasattr(owner, name) or name in inner or not text:
            known = [f.name for f in dataclasses.fields(settings) if f.name not in inner]
            known += [f"{s}.{f.name}" for s in inner for f in dataclasses.fields(getattr(settings, s))]
            near = difflib.get_close_matches(key, known, 1)
            hint = f", did you mean {near[0]!r}?" if near else ": expected key=value"
            raise UserError(f"{change}: unknown setting{hint}")
        (inner[section] if dot else top)[name] = _value(getattr(owner, name), text, change)
    nested = {k: dataclasses.replace(getattr(settings, k), **v) for k, v in inner.items() if v}
    return dataclasses.replace(settings, **top, **nested)


def _value(old: Any, text: str, change: str) -> Any:
    """`text` as a value of the type of `old`."""
    try:
        if isinstance(old, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(old, tuple):
            values = tuple(float(v) for v in text.strip("[]()").split(","))
            if len(values) != len(old):
                raise ValueError
            return values
        return type(old)(text) if old is not None else text
    except (ValueError, KeyError):
        raise UserError(f"{change}: not a value of type {type(old).__name__}") from None


def preset(name: str, **changes: Any) -> Settings:
    """A preset with some settings replaced. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"unknown preset {name!r}: one of {', '.join(PRESETS)}")
    return dataclasses.replace(PRESETS[name], **changes)
