"""Laws of other packages in the place of our compiled ones: checked once, then asked at every point."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError, as_user_error
from synth.fem.laws import lame, least_determinant
from synth.job.laws import LAWS, Law, load_law

Floats = NDArray[np.float64]

_STEP, _CLOSE = 1e-5, 1e-4


def stress(name: str, strain: Floats, mu: float, lam: float, out: Floats, energy: Floats) -> float:
    """As `laws.stress`, of a plug-in: energy (n,) and stress (n, 3, 3) at gradients F - I, in place.

    Raises:
        UserError: the law is not what it must be; see `check_law`.
    """
    law, label = checked(name)
    with np.errstate(all="ignore"), as_user_error(label):  # where it has no value it says so, below
        found, first = map(np.asarray, law.stress(strain + np.eye(3), mu, lam))
    if found.shape != energy.shape or first.shape != out.shape:
        raise UserError(f"{label}: stress gives {found.shape}, {first.shape}, not {out.shape}")
    least = float(least_determinant(strain)[0])
    energy[:] = np.where(np.isfinite(found), found, np.inf)
    out[:] = np.where(np.isfinite(first), first, 0.0)
    return least


@cache
def checked(name: str) -> tuple[Law, str]:
    """The law of that name, once it has passed `check_law`, and what messages call it."""
    law, label = load_law(name), LAWS.label(name)
    with as_user_error(label):
        check_law(law)
    return law, label


def check_law(law: Law) -> None:
    """Refuses a law whose answers would be wrong without a sign.

    Raises:
        UserError: wrong shapes; at rest not Hooke's; a stress that is not the slope of the energy; a turn of
            the whole that changes the energy; lambda that does not act as lambda/2 (log J)^2.
    """
    mu, lam = lame(1.0, 0.4)
    rng = np.random.default_rng(0)
    f = np.eye(3) + 0.15 * rng.uniform(-1, 1, (8, 3, 3))
    energy, first = (np.asarray(one, np.float64) for one in law.stress(f, mu, lam))
    if energy.shape != (8,) or first.shape != (8, 3, 3):
        raise UserError(f"stress must give (n,) and (n, 3, 3), not {energy.shape}, {first.shape}")
    way = rng.normal(size=(8, 3, 3))
    up, down = (law.stress(f + sign * _STEP * way, mu, lam)[0] for sign in (1, -1))
    _agree((up - down) / (2 * _STEP), np.einsum("nij,nij->n", first, way), "is not the slope of its energy")
    still = np.eye(3)[None]
    _agree(law.stress(still, mu, lam)[1], np.zeros((1, 3, 3)), "is not zero at rest")
    small = 1e-6 * (way + way.transpose(0, 2, 1))
    hooke = 2 * mu * small + lam * np.trace(small, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    _agree(law.stress(np.eye(3) + small, mu, lam)[1] / 1e-6, hooke / 1e-6, "is not Hooke's near rest")
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    _agree(law.stress(turn @ f, mu, lam)[0], energy, "depends on how the whole is turned")
    more = law.stress(f, mu, lam + 1.0)[0] - energy
    _agree(more, 0.5 * np.log(np.linalg.det(f)) ** 2, "takes lambda otherwise than as lambda/2 (log J)^2")


def _agree(found: Floats, expected: Floats, fault: str) -> None:
    size = float(np.abs(expected).max()) or 1.0
    if not np.abs(found - expected).max() <= _CLOSE * size:  # NaN is none either
        raise UserError(f"its stress {fault}")
