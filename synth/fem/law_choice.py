"""Material laws that a job can name, their valid loads, and the choice of `auto`: without a compiler."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np

from synth.arguments import checked
from synth.arrays import Floats
from synth.errors import InvalidValue, UserError, as_user_error
from synth.plugins import Registry

LARGEST_LOAD = {"linear": 0.2, "corotational": 0.2, "neo-hookean": 0.4, "ogden": np.inf}
"""Largest P = F/(E a^2) at which a law is accepted: its worst error there is 6.0%, and a straight push of the
default mesh holds det F over 0.5. Neo-Hookean is what the others are measured against. What Ogden's law and
driven contacts bear is found while solving: det F and the search for equilibrium decide."""

LAW_ERROR = {  # largest displacement error by law: (P, relative error)
    "linear": ((0.02, 0.0051), (0.05, 0.0133), (0.1, 0.0275), (0.15, 0.0429), (0.2, 0.0597)),
    "corotational": ((0.02, 0.0048), (0.05, 0.0118), (0.1, 0.0234), (0.15, 0.0371), (0.2, 0.0570)),
}
"""Relative to neo-Hookean, the worst of pushing, pulling and dragging aside, nu 0.4; measured by
`python -m evidence fem.pareto` (docs/results/fem/pareto)."""

CHEAPEST_FIRST = ("linear", "neo-hookean", "corotational")
"""Laws by CPU time a frame, from the same measurement."""

LEAST_JACOBIAN = 0.2  # smallest det F allowed in a frame; below it, elements are about to turn inside out

_TOLERANCE = 0.05  # displacement error relative to neo-Hookean that `law: auto` accepts

LAWS = Registry("sulcus.law", "fem.law", "law", dict.fromkeys(LARGEST_LOAD, ""), "auto")
"""Laws by name: an entry point is a `Law`, or a callable without arguments that returns one."""


class Law(Protocol):
    """The energy density of a material, and its derivative."""

    largest_load: float
    """Largest P = F/(E a^2) at which jobs are accepted with it."""

    def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
        """Energy density and first Piola-Kirchhoff stress at gradients F.

        Args:
            f: (n, 3, 3) deformation gradients; J = det F may be negative while a solution is searched.
            mu: Lame's mu [kPa]; at rest the law is Hooke's of mu and lam.
            lam: Lame's lambda [kPa], or the part of it that acts at points: most acts on element means.

        Returns:
            (n,) kPa, infinite where the law has no value, and (n, 3, 3) kPa, its derivative by F.
        """
        ...


@checked
def add_law(name: str, law: Law) -> None:
    """Registers a law under a name for `fem.law` in this process, to try it before it is packaged.

    `simulate` can then use it; the worker processes of `render` can't, they need an installed package.

    Raises:
        UserError: the name is taken.
    """
    LAWS.add(name, law)


@dataclass(frozen=True)
class LoadRange:
    """The ranges that the peak load of an instrument is drawn from."""

    load: tuple[float, float]  # P = F/(E a^2), where no force is given
    force_mn: tuple[float, float] | None
    footprint_mm: tuple[float, float]  # radius a of the contact

    def largest(self, young_kpa: float) -> float:
        """Largest P on tissue with a Young's modulus of at least `young_kpa`."""
        if self.force_mn is None:
            return self.load[1]
        return self.force_mn[1] / (young_kpa * self.footprint_mm[0] ** 2)


def check_load_range(law: str, loads: LoadRange, young_kpa: float, label: str) -> None:
    """`check_load` of the largest load on the softest tissue; `label` begins the message."""
    load, radius = loads.largest(young_kpa), loads.footprint_mm[0]
    if loads.force_mn is None:
        check_load(law, load, f"{label}load {load:g} is")
    else:
        most = f"{label}force_mn {loads.force_mn[1]:g} on the softest tissue ({young_kpa:g} kPa)"
        what = f"{most} under the smallest contact ({radius:g} mm) is a load of {load:.3g},"
        check_load(law, load, what, young_kpa * radius**2)


def check_load(law: str, load: float, what: str, per_load: float = 1.0) -> None:
    """Raises InvalidValue, which begins with `what`, for a load P = F/(E a^2) above the law's largest.

    `per_load`: from loads to the unit of the message.
    """
    if load > (largest := largest_load(law)) * (1 + 1e-9):  # a force as a load is rounded
        valid = f"the largest valid value is {largest * per_load:.4g}"
        raise InvalidValue(f"{what} past the range of the {law} law; {valid}")


@cache
def load_law(name: str) -> Law:
    """The law of a plug-in. UserError if there is none of that name, or its package can't be loaded."""
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
    """Relative error of a law at P = `load`, interpolated in `LAW_ERROR`; infinite beyond its last entry."""
    if law in ("neo-hookean", "ogden"):
        return 0.0
    loads, errors = np.transpose([(0.0, 0.0), *LAW_ERROR[law]])
    return float(np.interp(load, loads, errors, right=np.inf))


def choose_law(law: str, load: float) -> tuple[str, str]:
    """The law to use up to P = `load`, and the reason; `auto` selects the cheapest one within 5%."""
    if law != "auto":
        return law, "named in the job"
    name = next(name for name in CHEAPEST_FIRST if law_error(name, load) <= _TOLERANCE)
    error = law_error(name, load)
    return name, f"cheapest law within {_TOLERANCE:.1%} up to P = {load:g}: measured error {error:.1%}"
