"""Resampling to the grid and its channels, against closed forms."""

import numpy as np
import pytest
import torch

from learn.data.grid import CHANNELS, Grid, GridView, Scales, settle
from learn.network.channels import channels, divergence, rotate

GRID = Grid(64, 36.0)


def view_whole(shape: tuple[int, int], scale: float) -> GridView:
    return GridView(np.ones(shape, bool), scale, GRID)


@pytest.mark.parametrize(("shape", "scale"), [((300, 400), 0.06), ((40, 52), 0.5), ((30, 36), 1.1)])
def test_totals_are_preserved_at_any_scale(shape: tuple[int, int], scale: float) -> None:
    y, x = np.indices(shape)
    blob = np.exp(-((x - shape[1] / 2 - 3) ** 2 + (y - shape[0] / 2) ** 2) * (scale / 3) ** 2)
    on_grid = view_whole(shape, scale).sum(blob)
    assert on_grid.sum(dtype=np.float64) == pytest.approx(blob.sum(), rel=1e-4)


@pytest.mark.parametrize(("shape", "scale"), [((300, 400), 0.06), ((72, 72), 0.5), ((36, 36), 1.0)])
def test_a_linear_field_stays_the_same_field_in_mm(shape: tuple[int, int], scale: float) -> None:
    y, x = np.indices(shape)
    field = 0.02 * (x - (shape[1] - 1) / 2) * scale - 0.01 * (y - (shape[0] - 1) / 2) * scale
    on_grid = view_whole(shape, scale).mean(field)
    node = (np.arange(64) - 31.5) * GRID.pitch_mm
    expected = 0.02 * node[None, :] - 0.01 * node[:, None]
    inner = slice(26, 38)
    np.testing.assert_allclose(on_grid[inner, inner], expected[inner, inner], atol=2e-3)


def test_pixels_outside_the_mask_do_not_count() -> None:
    tissue = np.zeros((72, 72), bool)
    tissue[:, 20:] = True
    field = np.where(tissue, 1.0, 1e6)
    on_grid = GridView(tissue, 0.5, GRID, (35.5, 35.5)).mean(field)
    assert set(np.unique(on_grid)) <= {0.0, 1.0}


def test_divergence_of_a_stretch_is_the_sum_of_its_strains_up_to_the_masks_edge() -> None:
    mask = torch.zeros(1, 1, 64, 64)
    mask[..., 10:50, 8:56] = 1
    node = ((torch.arange(64) - 31.5) * GRID.pitch_mm).expand(64, 64)
    strain = divergence(torch.stack([0.03 * node, 0.01 * node.T])[None], mask, GRID.pitch_mm)
    assert torch.all(strain[mask == 0] == 0)
    inner = strain[..., 14:46, 12:52]
    torch.testing.assert_close(inner, torch.full_like(inner, 0.04), rtol=1e-4, atol=1e-5)
    # The published channel has one sign flipped, which would give 0.02.
    assert strain[mask == 1].min() > 0.02
    shift = divergence(torch.full((1, 2, 64, 64), 0.7), mask, GRID.pitch_mm)
    assert shift.abs().max() < 1e-5


def test_channel_order_and_units() -> None:
    mask = torch.ones(1, 1, 64, 64)
    u = torch.tensor([3.0, -4.0]).view(1, 2, 1, 1).expand(1, 2, 64, 64)
    x = channels(u, mask, GRID.pitch_mm, Scales(2.0, 1.0, 1.0, 1.0, 1.0), torch.full_like(mask, 0.5))
    assert CHANNELS == ("dx", "dy", "magnitude", "mask", "divergence")
    assert x[0, :, 32, 32].tolist() == pytest.approx([1.5, -2.0, 2.5, 1.0, 0.0, 0.5], abs=1e-5)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_turning_turns_vectors_and_leaves_divergence_unchanged(quarter: int, mirror: bool) -> None:
    rng = np.random.default_rng(0)
    node = (np.arange(32) - 15.5) / 16
    y, x = np.meshgrid(node, node, indexing="ij")
    a, b = rng.normal(size=(2, 3))
    u = np.stack([a[0] * x + a[1] * x * y + a[2] * y**2, b[0] * y + b[1] * x**2 + b[2] * x * y])
    u = u.astype(np.float32)
    mask = torch.ones(1, 1, 32, 32)

    def div(v: torch.Tensor) -> torch.Tensor:
        return divergence(v, mask, 1.125)

    turn, field = quarter + 4 * mirror, torch.from_numpy(u)[None]
    torch.testing.assert_close(div(rotate(field, turn)), rotate(div(field), turn), atol=1e-5, rtol=0)
    # A field that points outwards everywhere still does.
    outward = torch.from_numpy(np.stack([x, y]).astype(np.float32))[None]
    torch.testing.assert_close(rotate(outward, turn), outward, atol=1e-6, rtol=0)


def test_a_turn_is_counter_clockwise_in_the_picture() -> None:
    right = torch.zeros(1, 3, 4, 4)
    right[0, :, 1, 3] = torch.tensor([1.0, 0.0, 9.0])
    assert rotate(right, 1)[0, :, 0, 1].tolist() == [0.0, -1.0, 9.0]


def test_force_in_border_cells_is_moved_inside() -> None:
    mask = np.zeros((6, 6), np.float32)
    mask[1:5, 1:4] = 1
    amount = np.random.default_rng(0).normal(size=(3, 6, 6)).astype(np.float32)
    inside = settle(amount, mask)
    np.testing.assert_allclose(inside.sum((1, 2)), amount.sum((1, 2)), rtol=1e-5)
    assert (inside[:, mask == 0] == 0).all()
    # The centre has no neighbour outside; the right edge gets all of its row's.
    np.testing.assert_array_equal(inside[:, 2, 2], amount[:, 2, 2])
    np.testing.assert_allclose(inside[:, 2, 3], amount[:, 2, 3:].sum(-1), rtol=1e-6)
