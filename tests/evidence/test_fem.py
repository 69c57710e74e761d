"""Measurements of the physics at small size: refinement of the mesh, discs on the half-space."""

import numpy as np
import pytest

from evidence.fem import case, half_space, relief


@pytest.mark.slow
def test_error_decreases_with_refinement() -> None:
    on, contact = case.patch(3600), case.CONTACTS[0]
    fine, middle, coarse = (
        case.moved(case.brain(on, "linear", tets, contact), 0.1, "pull", 1) for tets in (2000, 1200, 500)
    )
    assert case.error(middle, fine, on) < 0.06
    assert case.error(middle, fine, on) < 0.7 * case.error(coarse, fine, on)


@pytest.mark.slow
def test_discs_on_the_half_space_agree_with_closed_forms() -> None:
    rows = {(row["disc"], row["part"]): row["error"] for row in half_space.errors(2500, 0.4)}
    assert max(error for (_, part), error in rows.items() if part.startswith(("u_z", "u_x"))) < 0.025
    assert max(error for (_, part), error in rows.items() if part.startswith("u_r")) < 0.08


@pytest.mark.slow
def test_a_membrane_on_the_half_space_agrees_with_hankel_integrals() -> None:
    radii = np.array([1.0, 3.0, 6.0])
    for disc in ("uniform", "hertz", "tangential"):  # integrals without a membrane: closed forms
        found = half_space.covered(radii, 4.5, 0.45, 0.0, disc)
        for part, value in half_space.bare(radii, 4.5, 0.45, disc).items():
            np.testing.assert_allclose(found[part], value, rtol=2e-5)
    rows = half_space.errors(3000, 0.4, 50.0)
    assert max(row["error"] for row in rows if not row["part"].startswith("u_r")) < 0.03
    assert max(row["error"] for row in rows) < 0.08


@pytest.mark.slow
def test_a_scene_with_relief_converges() -> None:
    coarse, fine = relief.summarise(
        [relief.measure_scene(2, count) for count in (400, 1600, 3500)], [400, 1600, 3500]
    )
    assert fine["mean_worst"] < min(0.03, coarse["mean_worst"])
