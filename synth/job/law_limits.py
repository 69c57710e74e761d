"""How far each law holds: plain numbers, so that reading a job needs no compiler."""

from __future__ import annotations

LARGEST_LOAD = {"linear": 0.2, "corotational": 0.2, "stable": 0.3, "neo-hookean": 0.4}
"""Largest P = F/(E a^2) at which a law is accepted: its worst error there is 6.0%, and a straight push of the
default mesh holds det F over 0.5. Neo-Hookean is what the others are measured against."""

LAW_ERROR = {
    "linear": ((0.02, 0.0051), (0.05, 0.0133), (0.1, 0.0275), (0.15, 0.0429), (0.2, 0.0597)),
    "stable": ((0.02, 0.0014), (0.05, 0.0035), (0.1, 0.0075), (0.15, 0.0122), (0.2, 0.0180), (0.3, 0.0373)),
    "corotational": ((0.02, 0.0048), (0.05, 0.0118), (0.1, 0.0234), (0.15, 0.0371), (0.2, 0.0570)),
}
"""Load and error against neo-Hookean, the worst of pushing, pulling and dragging aside, nu 0.4; from
`bench pareto fem` (docs/results/fem/pareto)."""

CHEAPEST_FIRST = ("linear", "stable", "neo-hookean", "corotational")
"""Laws by CPU time a frame, from the same measurement."""

LEAST_JACOBIAN = 0.2
"""Smallest det F a frame may hold; below it, elements are about to turn inside out."""


RIGID_GESTURES = ("push", "slide", "tap")
"""What a rigid tip can do; tissue that is pulled, grasped or held aside is held by more than pressure."""


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


def choose(law: str, load: float, tolerance: float) -> tuple[str, str]:
    """The law to use up to P = `load`, and why; `auto` takes the cheapest one within the tolerance."""
    if law != "auto":
        return law, "asked for"
    for name in CHEAPEST_FIRST:
        error = law_error(name, load)
        if error <= tolerance:
            return name, f"cheapest law within {tolerance:.1%} up to P = {load:g}: measured error {error:.1%}"
    raise AssertionError("neo-Hookean is the reference: its error is none")


SPHERE = 2.0
"""Radius of a rigid sphere as a multiple of the contact's radius a: at P = 0.4 it touches within 0.8 a."""


def depth_of_load(tip: str, load: float, poisson: float) -> float:
    """How deep a rigid tip sinks into a half-space, as a part of its radius (Sneddon, Int. J. Eng. Sci. 3,
    1965).

    Args:
        tip: `flat` (taken as sharp-edged) or `sphere` (taken as a paraboloid of radius `SPHERE` a).
        load: P = F/(E a^2).
        poisson: its ratio.
    """
    pressed = load * (1 - poisson**2)
    return pressed / 2 if tip == "flat" else float((0.75 * pressed) ** (2 / 3) / SPHERE ** (1 / 3))


def load_of_depth(tip: str, depth: float, poisson: float) -> float:
    """The inverse of `depth_of_load`: P = F/(E a^2) at a depth that is a part of the radius a."""
    pressed = 2 * depth if tip == "flat" else depth**1.5 * SPHERE**0.5 / 0.75
    return float(pressed / (1 - poisson**2))
