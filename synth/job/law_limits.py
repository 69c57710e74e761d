"""How far each law holds: plain numbers, so that reading a job needs no compiler."""

from __future__ import annotations

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


def law_error(law: str, load: float) -> float:
    """Error of a law at P = `load` as a part, between the lines of `LAW_ERROR`; infinite past its end."""
    if law == "neo-hookean":
        return 0.0
    before = (0.0, 0.0)
    for at, error in LAW_ERROR[law]:
        if load <= at:
            return before[1] + (error - before[1]) * (load - before[0]) / (at - before[0])
        before = (at, error)
    return float("inf")


def choose(law: str, load: float) -> tuple[str, str]:
    """The law to use up to P = `load`, and why; `auto` takes the cheapest one within 5%."""
    if law != "auto":
        return law, "asked for"
    for name in CHEAPEST_FIRST:
        error = law_error(name, load)
        if error <= _TOLERANCE:
            return (
                name,
                f"cheapest law within {_TOLERANCE:.1%} up to P = {load:g}: measured error {error:.1%}",
            )
    raise AssertionError("neo-Hookean is the reference: its error is none")
