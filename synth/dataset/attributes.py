"""Attributes of a sequence read from an untrusted store: their types and limits are checked before use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from synth.errors import UserError
from synth.formats import STORE, check_format
from synth.system.checked_file import LARGEST_PIXELS
from synth.system.config_file import validate_values

FORMAT = "sulcus-sequence"

LARGEST_BYTES = 32_000_000  # of the file with the attributes: some 50,000 frames

_Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
_Number = Annotated[float, Field(ge=-1e12, le=1e12)]
_Triple = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Square = Annotated[list[_Triple], Field(min_length=3, max_length=3)]
_Four = Annotated[list[_Number], Field(min_length=4, max_length=4)]


class _Gesture(BaseModel):
    kind: str | None = None
    instrument: str | None = None
    load: _Number | None = None


class _Scenario(BaseModel):
    family: str | None = None
    gestures: list[_Gesture] = []


class Attributes(BaseModel):
    """Root attributes of a store. Optional ones are needed by some readers only; further ones are allowed."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)  # strict: no text for numbers

    index: Annotated[int, Field(ge=0, lt=10**12)]
    frames: Annotated[int, Field(ge=1, le=1_000_000)]
    size: Annotated[list[PositiveInt], Field(min_length=2, max_length=2)]
    content_hash: _Hash
    seal_hash: _Hash
    field_hashes: dict[str, _Hash]
    fps: Annotated[float, Field(gt=0, le=1e6)] | None = None
    young_kpa: Annotated[float, Field(gt=0, le=1e6)] | None = None
    poisson: Annotated[float, Field(ge=0, lt=0.5)] | None = None
    scale_mm_per_px: Annotated[float, Field(gt=0, le=1e3)] | None = None
    K: _Square | None = None
    distortion: Annotated[list[_Number], Field(max_length=14)] | None = None
    rotation: _Square | None = None
    translation: _Triple | None = None
    mesh_to_world: Annotated[list[_Four], Field(min_length=4, max_length=4)] | None = (
        None  # from a user's brain mesh to world axes
    )
    scenario: _Scenario | None = None
    mechanics: dict[str, Any] | None = None
    summary: dict[str, _Number | dict[str, _Number]] = {}
    timings: dict[str, _Number | dict[str, _Number]] = {}
    versions: dict[str, str] = {}


def check_attributes(attrs: Mapping[str, Any], label: str) -> None:
    """Raises UserError, with the store's name `label`, if it is not a sequence or an attribute is invalid."""
    if attrs.get("format") != FORMAT:
        raise UserError(f"{label}: is a Zarr store, but not a sequence")
    check_format(attrs.get("format_version"), STORE, label)
    width, height = validate_values(Attributes, dict(attrs), f"{label}: an attribute is invalid").size
    if width * height > LARGEST_PIXELS:
        raise UserError(f"{label}: {width} x {height} pixels per frame is too large")


def gestures_of(attrs: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The gesture of each instrument in a sequence's attributes."""
    return (attrs.get("scenario") or {}).get("gestures", [])  # type: ignore[no-any-return]


def cautions_of(attrs: Mapping[str, Any]) -> list[str]:
    """What is doubtful about a sequence's mechanics, as another program's files state them."""
    cautions = (attrs.get("mechanics") or {}).get("cautions", [])
    if not isinstance(cautions, list):
        return []
    texts = [caution[:500] for caution in cautions if isinstance(caution, str)]
    return ["".join(c if c.isprintable() else "?" for c in text) for text in texts]


def name_gestures(attrs: Mapping[str, Any], of: str = "kind") -> str:
    """Gestures of all instruments ("pull + push") or, by `of`, their "instrument"; may be empty."""
    return " + ".join(gesture[of] for gesture in gestures_of(attrs) if gesture.get(of))
