"""Material laws of other packages: checked once, then evaluated at every quadrature point."""

from __future__ import annotations

from functools import cache

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError, as_user_error
from synth.fem.law_choice import LAWS, Law, load_law
from synth.fem.laws import lame

_STEP, _CLOSE = 1e-5, 1e-4


def stress(name: str, strain: Floats, mu: float, lam: float, out: Floats, energy: Floats) -> None:
    """As `laws.stress`, of a plug-in: energy (n,) and stress (n, 3, 3) at gradients F - I, in place.

    Raises UserError as `check_law`.
    """
    law, label = load_checked(name)
    with np.errstate(all="ignore"), as_user_error(label):  # undefined values are handled below
        density, piola = map(np.asarray, law.stress(strain + np.eye(3), mu, lam))
    if density.shape != energy.shape or piola.shape != out.shape:
        raise UserError(f"{label}: stress gives {density.shape}, {piola.shape}, not {out.shape}")
    energy[:] = np.where(np.isfinite(density), density, np.inf)
    out[:] = np.where(np.isfinite(piola), piola, 0.0)


@cache
def load_checked(name: str) -> tuple[Law, str]:
    """The law of that name after `check_law`, and its label in messages."""
    law, label = load_law(name), LAWS.label(name)
    with as_user_error(label):
        check_law(law)
    return law, label


def check_law(law: Law) -> None:
    """Raises UserError for a law that would give wrong results silently."""
    mu, lam = lame(1.0, 0.4)
    rng = np.random.default_rng(0)
    f = np.eye(3) + 0.15 * rng.uniform(-1, 1, (8, 3, 3))
    energy, piola = (np.asarray(values, np.float64) for values in law.stress(f, mu, lam))
    if energy.shape != (8,) or piola.shape != (8, 3, 3):
        raise UserError(f"stress must give (n,) and (n, 3, 3), not {energy.shape}, {piola.shape}")
    direction = rng.normal(size=(8, 3, 3))
    up, down = (law.stress(f + sign * _STEP * direction, mu, lam)[0] for sign in (1, -1))
    _require_close(
        (up - down) / (2 * _STEP), np.einsum("nij,nij->n", piola, direction), "is not its energy's derivative"
    )
    identity = np.eye(3)[None]
    _require_close(law.stress(identity, mu, lam)[1], np.zeros((1, 3, 3)), "is not zero at rest")
    strain = 1e-6 * (direction + direction.transpose(0, 2, 1))
    hooke = 2 * mu * strain + lam * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    _require_close(
        law.stress(np.eye(3) + strain, mu, lam)[1] / 1e-6, hooke / 1e-6, "is not Hooke's law near rest"
    )
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    _require_close(law.stress(rotation @ f, mu, lam)[0], energy, "changes under a rotation of the whole")
    change = law.stress(f, mu, lam + 1.0)[0] - energy
    _require_close(
        change, 0.5 * np.log(np.linalg.det(f)) ** 2, "does not depend on lambda as lambda/2 (log J)^2 does"
    )


def _require_close(actual: Floats, expected: Floats, fault: str) -> None:
    size = float(np.abs(expected).max()) or 1.0
    if not np.abs(actual - expected).max() <= _CLOSE * size:  # NaN fails as well
        raise UserError(f"its stress {fault}")
