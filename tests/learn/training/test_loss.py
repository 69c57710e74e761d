"""The losses, against numbers worked out by hand and against torchmetrics."""

from __future__ import annotations

import pytest
import torch
import torchmetrics
from pydantic import ValidationError

from learn.loss import Objective, gradient_shares, loss, unexplained
from synth.errors import UserError


def maps(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(1, 1, 1, -1)


MASK = maps(1, 1, 1, 0)
TRUE = maps(0.0, 0.1, 2.0, 9.0)
SAID = maps(0.4, 0.0, 1.0, 5.0)
# unit 4 → low below 0.2; spread 2. Errors over the spread: 0.2, -0.05, -0.5; the last cell is masked.


def test_by_hand() -> None:
    terms = loss(SAID, TRUE, MASK, Objective(), unit=4.0, spread=2.0)
    # Ghost only in the first cell: low, over-predicted. (3·0.04 + 0.0025 + 0.25) / 3
    assert float(terms.error) == pytest.approx(0.7 * (0.12 + 0.0025 + 0.25) / 3, rel=1e-6)
    # SSE 0.2925; truth over spread 0, .05, 1: mean 0.35, SST 1.0025 - 3·0.1225 = 0.635
    assert float(terms.r2) == pytest.approx(0.3 * 0.2925 / 0.635, rel=1e-6)
    assert float(terms.sum) == pytest.approx(float(terms.error + terms.r2))


def test_r2_is_that_of_torchmetrics_and_sees_bias() -> None:
    torch.manual_seed(0)
    true, said = torch.rand(2, 1, 8, 8) * 4, torch.rand(2, 1, 8, 8) * 4
    mask = torch.ones(2, 1, 8, 8)
    metric = torchmetrics.R2Score()
    metric.update(said.flatten(), true.flatten())
    assert float(1 - unexplained(said, true, mask, 1.0)) == pytest.approx(float(metric.compute()), rel=1e-4)
    assert float(unexplained(true + 1, true, mask, 1.0)) > 0.5
    # What the published loss minimises can't see it at all.
    assert float(unexplained(true + 1, true, mask, 1.0, bias_blind=True)) == pytest.approx(0, abs=1e-5)


def test_a_batch_at_rest_has_a_finite_loss() -> None:
    terms = loss(SAID, torch.zeros_like(TRUE), MASK, Objective(), unit=4.0, spread=2.0)
    assert torch.isfinite(terms.sum)


def test_frame_rule_prices_every_over_prediction_of_a_low_frame() -> None:
    plain = Objective(r2_weight=0, ghost_weight=1)
    by_frame = Objective(r2_weight=0, ghost_weight=3, rule="frame", low=0.2)
    true = maps(0.0, 0.1, 1.9, 0.0)  # mean 0.67 < 0.2·4
    said = maps(0.4, 0.0, 2.9, 0.0)
    both = [float(loss(said, true, MASK, o, 4.0, 2.0).error) for o in (plain, by_frame)]
    assert both[0] == pytest.approx((0.04 + 0.0025 + 0.25) / 3, rel=1e-6)
    assert both[1] == pytest.approx((3 * 0.04 + 0.0025 + 3 * 0.25) / 3, rel=1e-6)


def test_other_losses() -> None:
    def of(kind: str) -> float:
        return float(loss(SAID, TRUE, MASK, Objective(kind=kind), 4.0, 2.0).sum)  # type: ignore[arg-type]

    assert of("mse") == pytest.approx(0.2925 / 3)
    assert of("mae") == pytest.approx(0.75 / 3)
    assert of("huber") == pytest.approx(0.5 * 0.2925 / 3)


def test_total_force_term() -> None:
    objective = Objective(kind="mse", total_weight=2.0)
    terms = loss(SAID, TRUE, MASK, objective, 4.0, 2.0, cell_mm2=0.5, force_unit=1.0)
    assert float(terms.total) == pytest.approx(2 * (0.5 * (1.4 - 2.1)) ** 2, rel=1e-5)


def test_a_long_wrong_vector_is_a_ghost_a_short_one_is_not() -> None:
    true = torch.zeros(1, 3, 1, 2)
    true[0, :, 0, 0] = torch.tensor([0.1, 0.0, 0.0])
    said = torch.zeros(1, 3, 1, 2)
    said[0, :, 0, 0] = torch.tensor([0.0, -0.3, 0.0])
    ones = torch.ones(1, 1, 1, 2)
    error = loss(said, true, ones, Objective(r2_weight=0), 4.0, 1.0).error
    assert float(error) == pytest.approx(3 * 0.1 / 6, rel=1e-5)


def test_gradient_shares_add_up_and_follow_the_weights() -> None:
    said = SAID.clone().requires_grad_()
    half = gradient_shares(loss(said, TRUE, MASK, Objective(), 4.0, 2.0), said)
    assert sum(half.values()) == pytest.approx(1)
    assert 0.2 < half["error"] < 0.8
    said = SAID.clone().requires_grad_()
    assert gradient_shares(loss(said, TRUE, MASK, Objective(r2_weight=1.0), 4.0, 2.0), said)["r2"] == 1


def test_the_hinge_prices_force_on_contact_free_tissue_alone_and_linearly() -> None:
    """0.4 mN/mm² on the first cell (truth 0; free is under 0.04), none on the second."""
    objective = Objective(kind="hinge", r2_weight=0.0, stray_weight=1.5)
    terms = loss(SAID, TRUE, MASK, objective, unit=4.0, spread=2.0)
    assert float(terms.ghost) == pytest.approx(1.5 * 0.4 / 3 / 2.0, rel=1e-5)
    assert float(terms.error) == pytest.approx(0.2925 / 3, rel=1e-5)
    small = torch.tensor([1e-4, 0.1, 2.0, 0.0]).view_as(TRUE).requires_grad_()
    pull = {
        kind: torch.autograd.grad(
            loss(small, TRUE, MASK, Objective(kind=kind, r2_weight=0.0), 4.0, 2.0).sum,  # type: ignore[arg-type]
            small,
        )[0][0, 0, 0, 0]
        for kind in ("hinge", "antighost", "mse")
    }
    # The last tenth of a thousandth: three times next to nothing is next to nothing.
    assert pull["antighost"] == pytest.approx(3 * float(pull["mse"]), rel=1e-3)
    assert pull["hinge"] > 1000 * pull["antighost"]


def test_beyond_the_cap_more_force_costs_no_more() -> None:
    objective = Objective(kind="hinge", r2_weight=0.0, stray_weight=1.5, stray_cap=0.025)
    said = SAID.clone().requires_grad_()
    ghost = loss(said, TRUE, MASK, objective, unit=4.0, spread=2.0).ghost
    assert float(ghost.detach()) == pytest.approx(1.5 * 0.1 / 3 / 2.0, rel=1e-5)
    assert not torch.autograd.grad(ghost, said)[0].any()


def test_r2_frame_by_frame_gives_a_weak_frame_the_weight_of_a_strong_one() -> None:
    torch.manual_seed(1)
    true = torch.rand(1, 1, 8, 8)
    pair = torch.cat([4 * true, 2 * true])
    ones = torch.ones(2, 1, 8, 8)
    weak = pair * torch.tensor([1.0, 0.5]).view(2, 1, 1, 1)
    strong = pair * torch.tensor([0.5, 1.0]).view(2, 1, 1, 1)
    both = [float(unexplained(said, pair, ones, 1.0, by_frame=True)) for said in (weak, strong)]
    assert both[0] == pytest.approx(both[1], rel=1e-4)
    whole = [float(unexplained(said, pair, ones, 1.0)) for said in (weak, strong)]
    assert whole[1] == pytest.approx(4 * whole[0], rel=1e-4)
    alone = [float(unexplained(s[None], p[None], ones[:1], 1.0)) for s, p in zip(weak, pair, strict=True)]
    assert both[0] == pytest.approx(sum(alone) / 2, rel=1e-4)
    # A rest frame among them divides by no zero.
    assert torch.isfinite(unexplained(weak, 0 * pair, ones, 1.0, by_frame=True))


def test_the_length_of_a_zero_vector_has_a_gradient() -> None:
    said = torch.zeros(1, 3, 1, 2, requires_grad=True)
    true, ones = torch.zeros(1, 3, 1, 2), torch.ones(1, 1, 1, 2)
    loss(said, true, ones, Objective(kind="hinge"), 4.0, 1.0).sum.backward()
    assert said.grad is not None
    assert torch.isfinite(said.grad).all()


def test_the_head_is_held_to_the_total() -> None:
    objective = Objective(kind="mse", head_weight=0.5)
    totals = (torch.tensor([[1.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, 0.0]]))
    terms = loss(SAID, TRUE, MASK, objective, 4.0, 2.0, force_unit=10.0, totals=totals)
    assert float(terms.head) == pytest.approx(0.5 * 0.05)


def test_bad_weights_and_an_empty_mask() -> None:
    with pytest.raises(ValidationError, match="r2_weight"):
        Objective(r2_weight=1.5)
    with pytest.raises(ValidationError, match=r"r2_scope\n.*'cell'"):
        Objective(r2_scope="cell")  # type: ignore[arg-type]
    with pytest.raises(ValidationError, match=r"kind\n.*'l3'"):
        Objective(kind="l3")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="without a single tissue cell"):
        loss(SAID, TRUE, torch.zeros_like(MASK), Objective(), 4.0, 2.0)
