"""Settings of a training run, and their presets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from learn.data.clips import Input, has_depth
from learn.data.grid import Grid
from learn.loss import LOSSES
from learn.network.registry import DEFAULT, NETWORKS, load_network
from learn.network.shape import Shape
from synth.errors import InvalidValue, UserError, did_you_mean
from synth.job.types import NonNegative, Positive, Section
from synth.system import checked_file
from synth.system.config_file import override

Count = Annotated[int, Field(ge=0)]
AtLeastOne = Annotated[int, Field(ge=1)]
S = TypeVar("S", bound=Section)


class TrainingSettings(Section):
    """One training run: same settings, same data, same weights (bit for bit, on one CPU)."""

    size: Annotated[int, Field(ge=16, le=1024, multiple_of=16)] = 256
    """Cells along the grid's edge."""
    extent_mm: Annotated[Positive, Field(le=1e4)] = 36.0
    """Width of the grid [mm]."""
    network: str = DEFAULT
    """Kind of network: `d2fnet`, `ridge`, or one of another package."""
    arch: Annotated[SerializeAsAny[Shape], Field(validate_default=True)] = Shape()
    """The network's shape, in the keys of its kind."""
    loss: str = "antighost"
    """One of `learn.loss.LOSSES`; of networks that are trained by gradient descent."""
    input: Input = "ideal"
    """Displacement to train on. `mixed`: drawn for each frame, ideal, recovered, or ideal with another error
    (`learn.training.error_transfer`). `motion`, `motion-ideal`, `motion-mixed`: stereo motion, recovered,
    true or mixed; they need `arch.depth`."""
    epochs: AtLeastOne = 50
    batch: AtLeastOne = 8
    learning_rate: Positive = 5e-4
    schedule: Literal["plateau", "cosine"] = "plateau"
    """`plateau`: the learning rate is halved when the score stalls, as published; the best epoch is stored.
    `cosine`: a warm-up over a twentieth of the run, half a cosine to zero; the last epoch is stored."""
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

    @field_validator("network")
    @classmethod
    def _is_network(cls, name: str, info: ValidationInfo) -> str:
        return NETWORKS.check_name(name, info)

    @field_validator("arch", mode="plain")
    @classmethod
    def _of_network(cls, values: Any, info: ValidationInfo) -> Shape:
        if "network" not in info.data:  # which is reported
            return Shape()
        kind = load_network(info.data["network"]).shape
        if isinstance(values, Shape) and not isinstance(values, kind):
            values = values.model_dump(exclude_unset=True)
        return kind.model_validate(values, strict=True if info.mode == "json" else None)

    @field_validator("loss")
    @classmethod
    def _is_loss(cls, name: str) -> str:
        if name not in LOSSES:
            raise InvalidValue(f"there is no loss {name!r}; {', '.join(LOSSES)}{did_you_mean(name, LOSSES)}")
        return name

    @model_validator(mode="after")
    def _goes_together(self) -> TrainingSettings:
        if self.arch.depth != has_depth(self.input):
            raise ValueError(f"input {self.input!r} needs arch.depth {str(not self.arch.depth).lower()}")
        if self.size % self.arch.divisor:
            raise ValueError(f"size {self.size} is not divisible by {self.arch.divisor}, as arch needs")
        return self

    @property
    def grid(self) -> Grid:
        return Grid(self.size, self.extent_mm)


def replace(settings: S, **changes: Any) -> S:
    """Settings or an architecture with replaced values. Raises pydantic's ValidationError."""
    return type(settings).model_validate(dict(settings) | changes)


PRESETS: dict[str, TrainingSettings] = {
    name: TrainingSettings.model_validate(values)
    for name, values in checked_file.read_yaml(Path(__file__).with_name("presets.yaml")).items()
}


def preset(name: str, **changes: Any) -> TrainingSettings:
    """A preset with some settings replaced. Raises UserError for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"unknown preset {name!r}: one of {', '.join(PRESETS)}")
    return replace(PRESETS[name], **changes)


def change_preset(name: str, changes: Mapping[str, str]) -> TrainingSettings:
    """A preset with values from a command line, by `key` or `arch.key`.

    For another kind of network only what all kinds share is kept of the preset's `arch`. UserError: no such
    preset, network or key, or a wrong value.
    """
    base = preset(name)
    if (network := changes.get("network", base.network)) != base.network:
        load_network(network)
        shared = base.arch.model_dump(include=base.arch.model_fields_set.intersection(Shape.model_fields))
        base = replace(base, network=network, arch=shared)
    return override(base, [f"{key}={value}" for key, value in changes.items()])


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
