"""Types of the job's sections: a base class, and numbers, ranges and directions with their limits."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat
from pydantic import GetCoreSchemaHandler as Handler
from pydantic_core.core_schema import no_info_after_validator_function

Number = TypeVar("Number")


class Section(BaseModel):
    """One block of the job file. Unknown keys are errors; the text below a field is its documentation."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)


def _pair(value: Any) -> Any:
    return (value, value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def _check_order(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"the lower end {value[0]:g} is above the upper end {value[1]:g}")
    return value


def _check_rising(value: tuple[float, ...]) -> tuple[float, ...]:
    if list(value) != sorted(value) or value[0] == value[-1]:
        raise ValueError("levels of a tone curve must rise")
    return value


def _check_nonzero(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(value):
        raise ValueError("a direction must not be zero")
    return value


def _check_remainder(terms: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    if sum(share for share, _ in terms) >= 1:
        raise ValueError("the lost shares add up to the whole stiffness or more")
    return terms


Range = Annotated[tuple[Number, Number], BeforeValidator(_pair), AfterValidator(_check_order)]
"""From the lower to the upper end; a single number is both."""
Positive = Annotated[FiniteFloat, Field(gt=0)]
NonNegative = Annotated[FiniteFloat, Field(ge=0)]
Share = Annotated[FiniteFloat, Field(ge=0, le=1)]
PronyTerms = Annotated[
    tuple[tuple[Annotated[FiniteFloat, Field(gt=0, lt=1)], Positive], ...],
    Field(max_length=2),
    AfterValidator(_check_remainder),
]
"""Of a tissue that relaxes: lost shares of the stiffness, and their times [s]."""
Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Distortion = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
_Weight = Annotated[FiniteFloat, Field(ge=-8, le=8)]
Weights = tuple[_Weight, _Weight, _Weight]
Curve = Annotated[
    tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative], AfterValidator(_check_rising)
]
Direction = Annotated[Vector, AfterValidator(_check_nonzero)]
MembraneState = Literal["stripped", "unknown", "intact"]
"""Knowledge of the tissue's membrane (pia): removed, unknown, or present."""
Scenery = Literal["retractor", "bone", "drape", "clips", "hooks", "patties"]
Group = Literal["instruments", "texture", "surroundings", "light", "camera", "field"]
"""What domain randomisation draws at random."""


class Groups(dict[Group, float]):
    """Groups that are on, with their strengths; hashable, as a job is."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Handler) -> Any:
        schema = handler(dict[Group, Share])
        return no_info_after_validator_function(
            lambda groups: cls({k: v for k, v in groups.items() if v}), schema
        )


PlugInName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$", max_length=100)]
