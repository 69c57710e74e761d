"""How far each law holds: plain numbers, so that reading a job needs no compiler."""

from __future__ import annotations

LARGEST_LOAD = {"linear": 0.15, "corotational": 0.15, "stable": 0.4, "neo-hookean": 0.4}
"""Largest P = F/(E a^2) at which a law is accepted."""

LEAST_JACOBIAN = 0.2
"""Smallest det F a frame may hold; below it, elements are about to turn inside out."""
