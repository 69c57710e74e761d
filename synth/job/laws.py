"""Material laws that a job can name, how far each holds, and which one `auto` takes.

Plain numbers and plug-ins, so that reading a job needs no compiler; our laws themselves are `synth.fem.laws`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from synth.errors import InvalidValue, UserError, as_user_error
from synth.plugins import Registry

Floats = NDArray[np.float64]

LARGEST_LOAD = {"linear": 0.2, "corotational": 0.2, "neo-hookean": 0.4}
"""Largest P = F/(E a^2) at which a law is accepted: its worst error there is 6.0%, and a straight push of the
default mesh holds det F over 0.5. Neo-Hookean is what the others are measured against."""

LAW_ERROR = {
    "linear": ((0.02, 0.0051), (0.05, 0.0133), (0.1, 0.0275), (0.15, 0.0429), (0.2, 0.0597)),
    "corotational": ((0.02, 0.0048), (0.05, 0.0118), (0.1, 0.0234), (0.15, 0.0371), (0.2, 0.0570)),
}
"""Load and error against neo-Hookean, the worst of pushing, pulling and dragging aside, nu 0.4; from
`python -m evidence.fem.pareto` (docs/results/fem/pareto)."""

CHEAPEST_FIRST = ("linear", "neo-hookean", "corotational")
"""Laws by CPU time a frame, from the same measurement."""

LEAST_JACOBIAN = 0.2
"""Smallest det F a frame may hold; below it, elements are about to turn inside out."""

_TOLERANCE = 0.05
"""Error against neo-Hookean that `law: auto` accepts, as a part of the displacement."""

LAWS = Registry("sulcus.law", "fem.law", "law", dict.fromkeys(LARGEST_LOAD, ""), "auto")
"""Laws by name: an entry point is a `Law`, or a callable without arguments that makes one."""


class Law(Protocol):
    """An energy density of tissue, and its slope."""

    largest_load: float
    """Largest P = F/(E a^2) at which jobs are accepted with it."""

    def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
        """Energy density and first Piola-Kirchhoff stress at gradients F.

        Args:
            f: (n, 3, 3) deformation gradients; J = det F may be negative while a solution is searched.
            mu: Lame's mu [kPa]; at rest the law is Hooke's of mu and lam.
            lam: Lame's lambda [kPa], or what of it acts at points: most acts on elements' means.

        Returns:
            (n,) kPa, infinite where the law has no value, and (n, 3, 3) kPa, its derivative by F.
        """
        ...


def add_law(name: str, law: Law) -> None:
    """Makes a law a job's `fem.law` in this process: to try it before it is in a package.

    `simulate` then knows it; the processes of `render` don't, they need the package.

    Raises:
        UserError: the name is taken.
    """
    LAWS.add(name, law)


@dataclass(frozen=True)
class LoadRange:
    """What the peak load of an instrument is drawn from."""

    load: tuple[float, float]
    """P = F/(E a^2), where no force is given."""
    force_mn: tuple[float, float] | None
    footprint_mm: tuple[float, float]
    """Radius a of the contact."""

    def largest(self, young_kpa: float) -> float:
        """Largest P on tissue of at least that modulus."""
        if self.force_mn is None:
            return self.load[1]
        return self.force_mn[1] / (young_kpa * self.footprint_mm[0] ** 2)


def check_load_range(law: str, loads: LoadRange, young_kpa: float, label: str) -> None:
    """`check_load` of the largest load on the softest tissue; `label` comes before what it says."""
    load, radius = loads.largest(young_kpa), loads.footprint_mm[0]
    if loads.force_mn is None:
        check_load(law, load, f"{label}load {load:g} is")
        return
    what = (
        f"{label}force_mn {loads.force_mn[1]:g} on the softest tissue ({young_kpa:g} kPa) under the smallest "
        f"contact ({radius:g} mm) is a load of {load:.3g},"
    )
    check_load(law, load, what, young_kpa * radius**2)


def check_load(law: str, load: float, what: str, per_load: float = 1.0) -> None:
    """Refuses a load past what a law is known to describe.

    Args:
        law: its name.
        load: P = F/(E a^2).
        what: beginning of the message.
        per_load: what the largest valid load is multiplied by in the message.

    Raises:
        InvalidValue: it is.
    """
    largest = largest_load(law)
    if load > largest * (1 + 1e-9):  # a force turned into a load may be off by rounding
        valid = f"the largest valid value is {largest * per_load:.4g}"
        raise InvalidValue(f"{what} past the range of the {law} law; {valid}")


@cache
def load_law(name: str) -> Law:
    """The law that a plug-in offers under a name.

    Raises:
        UserError: no such law, or its package does not load or gives something else.
    """
    law: Law = LAWS.load(name)
    with as_user_error(LAWS.label(name)):
        good = callable(law.stress) and 0 < float(law.largest_load) < 10
    if not good:
        raise UserError(f"{LAWS.label(name)}: largest_load must be above 0 and below 10")
    return law


def largest_load(name: str) -> float:
    """Largest P = F/(E a^2) at which a law is accepted. UserError as `load_law`."""
    return LARGEST_LOAD[name] if name in LARGEST_LOAD else float(load_law(name).largest_load)


def law_error(law: str, load: float) -> float:
    """Error of a law at P = `load` as a part, between the lines of `LAW_ERROR`; infinite past its end."""
    if law == "neo-hookean":
        return 0.0
    loads, errors = np.transpose([(0.0, 0.0), *LAW_ERROR[law]])
    return float(np.interp(load, loads, errors, right=np.inf))


def choose_law(law: str, load: float) -> tuple[str, str]:
    """The law to use up to P = `load`, and why; `auto` takes the cheapest one within 5%."""
    if law != "auto":
        return law, "asked for"
    name = next(name for name in CHEAPEST_FIRST if law_error(name, load) <= _TOLERANCE)
    error = law_error(name, load)
    return name, f"cheapest law within {_TOLERANCE:.1%} up to P = {load:g}: measured error {error:.1%}"
