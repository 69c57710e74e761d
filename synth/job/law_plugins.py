"""Material laws of other packages, by name: read with the job, so that a name not known is one line there."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.job.law_limits import LARGEST_LOAD

Floats = NDArray[np.float64]

GROUP = "sulcus.law"
"""Entry-point group in which other packages offer laws: name -> a `Law`, or a callable that makes one."""


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


_added: dict[str, Law] = {}


def add_law(name: str, law: Law) -> None:
    """Makes a law a job's `fem.law` in this process: to try it before it is in a package.

    `simulate` then knows it; the processes of `render` don't, they need the package.

    Raises:
        UserError: the name is taken.
    """
    if name in names():
        raise UserError(f"fem.law: the name {name!r} is taken")
    _added[name] = law


def names() -> tuple[str, ...]:
    """The laws that can be named here: our own, then those of plug-ins and of `add_law`."""
    return (*LARGEST_LOAD, *sorted({*_points(), *_added} - set(LARGEST_LOAD)))


def largest_load(name: str) -> float:
    """Largest P = F/(E a^2) at which a law is accepted. UserError as `load`."""
    return LARGEST_LOAD[name] if name in LARGEST_LOAD else float(load(name).largest_load)


def source(name: str) -> str:
    """Package and version that a plug-in's law comes from; nothing for our own."""
    if name in LARGEST_LOAD or name in _added:
        return ""
    package = _point(name).dist
    return "" if package is None else f"{package.name} {package.version}"


@cache
def load(name: str) -> Law:
    """The law that a plug-in offers under a name.

    Raises:
        UserError: no such law, or its package does not load or gives something else.
    """
    if name in _added:
        return _added[name]
    point = _point(name)
    try:
        found: Any = point.load()
        law: Law = found() if isinstance(found, type) or not hasattr(found, "stress") else found
        good = callable(law.stress) and 0 < float(law.largest_load) < 10
    except Exception as error:  # whatever a package of others raises
        said = (str(error).splitlines() or [""])[0][:200]
        raise UserError(f"fem.law: {name} ({point.value}): {type(error).__name__}: {said}") from error
    if not good:
        raise UserError(f"fem.law: {name} ({point.value}): largest_load must be above 0 and below 10")
    return law


def _points() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def _point(name: str) -> EntryPoint:
    found = _points().get(name)
    if found is None:
        raise UserError(f"fem.law: no law {name!r}; there are {', '.join(names())}")
    return found
