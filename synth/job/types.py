"""What the job's sections are made of: their base class, and numbers and ranges with their limits."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
)


def _pair(value: Any) -> Any:
    """A single number stands for the range that holds only it."""
    return (value, value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"the lower end {value[0]:g} is above the upper end {value[1]:g}")
    return value


Positive = Annotated[FiniteFloat, Field(gt=0)]
NonNegative = Annotated[FiniteFloat, Field(ge=0)]
PositiveRange = Annotated[tuple[Positive, Positive], BeforeValidator(_pair), AfterValidator(_ordered)]
NonNegativeRange = Annotated[
    tuple[NonNegative, NonNegative], BeforeValidator(_pair), AfterValidator(_ordered)
]
_Instruments = Annotated[int, Field(ge=1, le=3)]
InstrumentRange = Annotated[
    tuple[_Instruments, _Instruments], BeforeValidator(_pair), AfterValidator(_ordered)
]
Share = Annotated[FiniteFloat, Field(ge=0, le=1)]
ShareRange = Annotated[tuple[Share, Share], BeforeValidator(_pair), AfterValidator(_ordered)]
_Tilt = Annotated[FiniteFloat, Field(ge=0, le=40)]
LightTilt = Annotated[tuple[_Tilt, _Tilt], BeforeValidator(_pair), AfterValidator(_ordered)]
_Kelvin = Annotated[FiniteFloat, Field(ge=2000, le=12_000)]
LightKelvin = Annotated[tuple[_Kelvin, _Kelvin], BeforeValidator(_pair), AfterValidator(_ordered)]
_Poisson = Annotated[FiniteFloat, Field(ge=0, lt=0.5)]
PoissonRange = Annotated[tuple[_Poisson, _Poisson], BeforeValidator(_pair), AfterValidator(_ordered)]
PlugInName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$", max_length=100)]
Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Section(BaseModel):
    """One block of the job file. Unknown keys are errors; text under a field is its documentation."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)
