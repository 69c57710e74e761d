"""Several instruments at once: gestures that leave each other room."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.fem.material import Tissue
from synth.fem.tool import Gesture, focus, shaft
from synth.job import schema
from synth.job.instrument import CLEAR_MM, Instrument

Floats = NDArray[np.float64]

_TRIES = 400
_ROUNDS = 8
_OVERLAP = 0.6  # centres at least this part of both radii apart: the pressures' sum peaks 10% above one's
_BLADE_MM, _SPREADING, _BODY_MM = 3.0, 0.3, 14.0  # room an instrument needs at its tip, growing up the shaft
_LENGTH_MM, _STEPS = 110.0, 23


def draw_crew(
    fem: schema.Fem,
    craniotomy: schema.Craniotomy,
    tissue: Tissue,
    rng: np.random.Generator,
    others: np.random.Generator,
) -> tuple[Gesture, ...]:
    """Draws the gestures of all instruments: those of `fem.crew` as they are asked, then the rest.

    Those that have a place come first, so that nothing that is drawn stands where one is wanted.

    Args:
        fem, craniotomy, tissue: as in `Gesture.draw`.
        rng: random numbers of this sequence's first gesture.
        others: of its further ones.

    Raises:
        UserError: the opening has no room for so many, or not there.
    """
    if not fem.crew:
        first = Gesture.draw(fem, craniotomy, tissue, rng)
        return (first, *further(first, fem, craniotomy, tissue, others))
    count = max(int(others.integers(fem.instruments[0], fem.instruments[1] + 1)), len(fem.crew))
    asked = [*fem.crew, *[Instrument()] * (count - len(fem.crew))]
    order = sorted(range(count), key=lambda k: asked[k].place is None)
    for _ in range(_ROUNDS):
        found: dict[int, Gesture] = {}
        for k in order:
            for _ in range(_TRIES):
                trial = Gesture.draw(fem, craniotomy, tissue, others if k else rng, asked[k])
                if fits(trial, craniotomy) and all(room(trial, other) >= 0 for other in found.values()):
                    found[k] = trial
                    break
            else:
                break  # the shaft of one before may stand in the way: all anew
        else:
            return tuple(found[k] for k in range(count))
    beside = f" beside the other {len(found)}" if found else ""
    raise UserError(
        f"fem.crew: instrument {k} has no room{beside} in an opening of {craniotomy.radius_mm:g} mm "
        f"radius{_within(fem)}; change its place, lower its footprint_mm, or widen "
        "anatomy.craniotomy.radius_mm"
    )


def _within(fem: schema.Fem) -> str:
    return "" if fem.within_mm is None else f" and fem.within_mm of {fem.within_mm:g}"


def fits(gesture: Gesture, craniotomy: schema.Craniotomy) -> bool:
    """Whether all that a gesture loads is in the opening, clear of its rim."""
    path, start = np.asarray(gesture.path_mm), np.array([c.point_mm for c in gesture.contacts])
    ends = np.concatenate([start, start + path])
    free = craniotomy.radius_mm - gesture.footprint_mm - CLEAR_MM
    return bool(np.hypot(*ends.T).max() <= max(free, 0.0) + 1e-9)


def further(
    first: Gesture, fem: schema.Fem, craniotomy: schema.Craniotomy, tissue: Tissue, rng: np.random.Generator
) -> tuple[Gesture, ...]:
    """Draws the gestures beside the first; each is redrawn until it has room.

    Args:
        first: the gesture of the first instrument.
        fem, craniotomy, tissue: as in `Gesture.draw`.
        rng: random numbers of this sequence's further gestures alone.

    Returns:
        One gesture less than there are instruments, a number drawn from `fem.instruments`.

    Raises:
        UserError: the opening has no room for so many.
    """
    count = int(rng.integers(fem.instruments[0], fem.instruments[1] + 1))
    crew = [first]
    while len(crew) < count:
        for _ in range(_TRIES):
            trial = Gesture.draw(fem, craniotomy, tissue, rng)
            if all(room(trial, other) >= 0 for other in crew):
                crew.append(trial)
                break
        else:
            raise UserError(
                f"fem.instruments: {count} have no room in an opening of {craniotomy.radius_mm:g} mm radius"
                f"{_within(fem)}; lower it or fem.footprint_mm, or widen anatomy.craniotomy.radius_mm"
                f"{' and fem.within_mm' if fem.within_mm else ''}"
            )
    return tuple(crew[1:])


def room(one: Gesture, other: Gesture) -> float:
    """How far apart two gestures are beyond what they need, mm: their contacts and their shafts."""
    here, there = np.array(focus(one)), np.array(focus(other))
    apart = np.linalg.norm(here[:, None, :2] - there[None, :, :2], axis=2)
    contacts = (apart - _OVERLAP * (here[:, None, 2] + there[None, :, 2])).min()
    s = np.linspace(0, _LENGTH_MM, _STEPS)
    lines = [np.append(g.point_mm, 0.0) + s[:, None] * shaft(g) for g in (one, other)]
    gap = np.linalg.norm(lines[0][:, None] - lines[1][None], axis=2)
    wide = np.minimum(_BLADE_MM + _SPREADING * np.maximum(s[:, None], s[None, :]), _BODY_MM)
    return float(min(contacts, (gap - wide).min()))
