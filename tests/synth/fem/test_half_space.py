"""Refinement of the mesh, and discs on the half-space against closed forms and Hankel integrals."""

import half_space
import numpy as np
import pressed_brain
import pytest


@pytest.mark.slow
def test_error_decreases_with_refinement() -> None:
    surface, contact = pressed_brain.patch(3600), pressed_brain.CONTACTS[0]
    fine, middle, coarse = (
        pressed_brain.solve_displacement(
            pressed_brain.brain(surface, "linear", tets, contact), 0.1, "pull", 1
        )
        for tets in (2000, 1200, 500)
    )
    assert pressed_brain.error(middle, fine, surface) < 0.06
    assert pressed_brain.error(middle, fine, surface) < 0.7 * pressed_brain.error(coarse, fine, surface)


@pytest.mark.slow
def test_discs_on_the_half_space_agree_with_closed_forms() -> None:
    rows = {(row["disc"], row["part"]): row["error"] for row in half_space.errors(2500, 0.4)}
    assert max(error for (_, part), error in rows.items() if part.startswith(("u_z", "u_x"))) < 0.025
    assert max(error for (_, part), error in rows.items() if part.startswith("u_r")) < 0.08


@pytest.mark.slow
def test_a_membrane_on_the_half_space_agrees_with_hankel_integrals() -> None:
    radii = np.array([1.0, 3.0, 6.0])
    for disc in ("uniform", "hertz", "tangential"):  # integrals without a membrane: closed forms
        displacements = half_space.solve_covered(radii, 4.5, 0.45, 0.0, disc)
        for part, value in half_space.solve_bare(radii, 4.5, 0.45, disc).items():
            np.testing.assert_allclose(displacements[part], value, rtol=2e-5)
    rows = half_space.errors(3000, 0.4, 50.0)
    assert max(row["error"] for row in rows if not row["part"].startswith("u_r")) < 0.03
    assert max(row["error"] for row in rows) < 0.08
