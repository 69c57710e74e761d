"""Where the skull is open, and what holds the brain inside."""

from __future__ import annotations

from dataclasses import dataclass

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Craniotomy:
    """An opening in the skull over a surface, in the surface's own axes."""

    point: Vector  # mm, on the surface or near it
    direction: Vector  # outward, of any length
    radius_mm: float = 12.0


@dataclass(frozen=True)
class Attachment:
    """A region in which tissue is fixed: falx, tentorium, an adhesion."""

    point: Vector  # mm, its centre
    radius_mm: float
    normal: Vector | None = None  # of a sheet through the centre, of any length; None: a ball
    thickness_mm: float = 3.0  # of a sheet
