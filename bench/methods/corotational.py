"""One contact on tissue that turns as it moves: the co-rotational law, corrected for on the linear inverse.

A pull turns the tissue under it, and a linear law takes the turn for motion along the picture. The law of
co-rotational elements (Mueller and Gross, Interactive virtual materials, Graphics Interface 2004) knows the
turn. Its own tangent is a poor guide here: seen from above, a turn looks like a load along the view, and an
adjoint on the force alone ran away along it. So what the law adds to linear displacement is computed at the
answer, taken off what was seen, and the linear problem solved again (deferred correction, Stetter, Numer.
Math. 29, 1978): every step is as well posed as the linear inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bench.methods import inverse
from bench.methods.compliance import TO_CAMERA, Block, Compliance, picture
from bench.methods.inverse import Contact
from synth.fem import equilibrium
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System

Floats = NDArray[np.float64]

_TETS = 1600
_STEPS = 3
_TOLERANCE = 2e-3
_LARGEST_LOAD = 2.0
"""F/(E a^2) beyond which the law is out of its range: five times what it can carry, for linear answers are
often several times too large. What is left unexplained is no test: wrong loads explain most turns well."""
_FAILED = 0.05
"""Out of balance by this part of the load: there is no answer of the law."""


@dataclass(frozen=True, eq=False)
class Tissue:
    """A co-rotational block under a compliance's points and nodes, E = 1 kPa."""

    system: System
    seen: Embedding
    """Surface displacement at the compliance's points."""
    held: Embedding
    """What carries loads from the compliance's nodes."""


@lru_cache(maxsize=2)
def build(known: Compliance) -> Tissue:
    """First-order elements: their turns are right, and what they lack in give is scaled for.

    On second-order ones the steps swing about the answer, and each costs six times as much.
    """
    block = Block.build("corotational", _TETS, 1)
    return Tissue(block.system, block.carry(known.points), block.carry(known.nodes))


def one_contact(known: Compliance, displacement: Floats, weight: Floats) -> Floats:
    """As `inverse.one_contact`, which it starts from and stays with where the law has no say.

    Args:
        known: for the points seen.
        displacement: (P, C) mm, C = 2 of one eye, 3 of two, as the compliance.
        weight: (P,) or (P, C) >= 0; 0 where nothing is seen.

    Returns:
        (3,) mN for E = 1 kPa, camera axes.
    """
    found = linear = inverse.contact(known, displacement, weight)
    moved: Floats | None = None
    for _ in range(_STEPS if found.force.any() else 0):
        if np.linalg.norm(found.force) > _LARGEST_LOAD * np.exp(2 * found.place[2]):
            return linear.force
        more = added(build(known), known, found, moved)
        if more is None:
            return linear.force
        extra, moved = more
        found = inverse.settle(known, displacement - extra, weight, found.place, 0.4)
    return found.force


def added(
    tissue: Tissue, known: Compliance, contact: Contact, start: Floats | None
) -> tuple[Floats, Floats] | None:
    """What the law adds to the linear displacement of a contact.

    Args:
        tissue: of the law.
        known: the linear map.
        contact: place and force.
        start: (N, 3) mm, a displacement nearby; None: the linear one.

    Returns:
        (P, C) mm and the volume's displacement (N, 3) mm; None without an equilibrium.
    """
    share = inverse.kernel(known, contact.place)
    load = tissue.held.gather(np.outer(share, TO_CAMERA.T @ contact.force))
    linear = tissue.system.solve(load)
    components = len(known.matrix) // len(known.points)
    stiff = picture(tissue.seen, linear, components).T.ravel()
    wanted = np.einsum("mka,k,a->m", known.matrix.reshape(len(stiff), -1, 3), share, contact.force)
    # The load that moves the stiffer mesh as far as this one moves the map's.
    give = float(stiff @ wanted) / max(float(stiff @ stiff), 1e-30)
    load, linear = give * load, give * linear
    size = max(float(np.vdot(load, linear)), 0.0) ** 0.5
    safe = np.zeros_like(linear)
    begin = linear if start is None else start
    moved, state, rest = equilibrium.minimise_energy(tissue.system, load, begin, _TOLERANCE * size, safe)
    if not np.isfinite(state.energy) or rest > _FAILED * size:
        return None
    return picture(tissue.seen, moved - linear, components), moved
