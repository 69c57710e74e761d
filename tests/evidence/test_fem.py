"""The physics' measurements, small: the page, a user's surface, order and size of the mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from evidence.fem import case, contact, half_space, relief, surface
from evidence.fem.stability import living, random_scenes


@pytest.mark.slow
def test_a_users_surface_is_measured_against_a_finer_mesh(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.vertices *= (30.0, 28.0, 26.0)
    path = tmp_path / "ball.ply"
    ball.export(path)
    found = surface.measure(path, np.array([0.0, 0.0, 1.0]), [300], 700)
    assert found["volume_mm3"] == pytest.approx(ball.volume, rel=0.02)
    (row,) = found["rows"]
    assert row["volume_kept"] == pytest.approx(1.0, abs=0.03)
    assert 0.001 < row["error"] < 0.3


@pytest.mark.slow
def test_error_falls_with_the_mesh_and_with_the_order() -> None:
    on, contact = case.patch(3600), case.CONTACTS[0]
    exact = case.moved(case.brain(on, "linear", 2, 2000, contact), 0.1, "pull", 1)

    def error(order: int, tets: int) -> float:
        return case.error(
            case.moved(case.brain(on, "linear", order, tets, contact), 0.1, "pull", 1), exact, on
        )

    assert error(2, 1200) < 0.06
    assert error(2, 1200) < 0.7 * error(2, 500)
    assert error(1, 1200) > 3 * error(2, 1200)


@pytest.mark.slow
def test_discs_on_the_half_space_come_out_as_in_the_books() -> None:
    rows = {(row["disc"], row["part"]): row["error"] for row in half_space.measure(2500, 0.4)}
    assert max(error for (_, part), error in rows.items() if part.startswith(("u_z", "u_x"))) < 0.025
    assert max(error for (_, part), error in rows.items() if part.startswith("u_r")) < 0.08


@pytest.mark.slow
def test_a_scene_on_its_relief_converges() -> None:
    rows = [relief.measure_scene(2, count) for count in (400, 1600, 3500)]
    coarse, fine = relief.summarise(rows, [400, 1600, 3500])
    assert fine["mean_worst"] < min(0.03, coarse["mean_worst"])
    assert relief.summarise([], [400, 1600]) == [{"tets": 400, "against": 1600, "scenes": 0}]


@pytest.mark.slow
def test_random_scenes_are_whole_and_step_evenly() -> None:
    found = random_scenes(3, 400, 0, frames=6)
    assert found["outcome"] == {"whole": 3}
    assert 0 < found["least_jacobian"] <= 1
    assert found["largest_step"] < 0.25


@pytest.mark.slow
def test_random_scenes_with_everything_on_are_whole() -> None:
    asked = [living(0, index) for index in range(20)]
    assert {(one["contact"], one["tip"], one["volume"]) for one in asked} >= {
        ("rigid", "flat", "auto"),
        ("rigid", "sphere", "auto"),
        ("traction", "flat", "auto"),
    }
    found = random_scenes(3, 300, 0, frames=6, everything=True)
    assert found["outcome"] == {"whole": 3}


@pytest.mark.slow
def test_rigid_tips_on_the_half_space_come_out_as_in_the_books() -> None:
    solid = contact.half_space(1600, 0.17)
    for tip, (_, radii) in contact.SHAPES.items():
        for radius in radii:
            row = contact.indent(solid, tip, radius)
            assert abs(row["depth_error"]) <= 0.03, row
            assert abs(row["radius_error"]) <= 0.03, row


@pytest.mark.slow
def test_a_dragged_tip_sticks_then_slips_as_cattaneo_found() -> None:
    for row in contact.drag(contact.half_space(1600, 0.17)):
        assert row["tangential"] == pytest.approx(row["exact"], abs=0.02)
        assert row["most_over_coulomb"] <= 1 + 1e-9
        assert row["normal_off"] <= 1e-8
        assert (row["sticking"] > 0) == (row["shift"] < 1)


@pytest.mark.slow
def test_a_membrane_on_the_half_space_comes_out_as_the_hankel_integrals() -> None:
    radii = np.array([1.0, 3.0, 6.0])
    for disc in ("uniform", "hertz"):  # without a membrane, the integrals are the closed forms
        found = half_space.covered(radii, 4.5, 0.45, 0.0, disc)
        down, out = half_space.axial(radii, 4.5, 0.45, disc)
        np.testing.assert_allclose(found["u_z"], down, rtol=2e-5)
        np.testing.assert_allclose(found["u_r"], out, rtol=2e-5)
    rows = half_space.measure(3000, 0.4, 50.0)
    assert max(row["error"] for row in rows if not row["part"].startswith("u_r")) < 0.03
    assert max(row["error"] for row in rows) < 0.08
