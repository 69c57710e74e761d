"""The losses, against numbers worked out by hand and against torchmetrics."""

import pytest
import torch
import torchmetrics

from learn.loss import loss, measure_unexplained


def maps(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(1, 1, 1, -1)


MASK = maps(1, 1, 1, 0)
TRUE = maps(0.0, 0.1, 2.0, 9.0)
PREDICTED = maps(0.4, 0.0, 1.0, 5.0)
# unit 4 → low below 0.2; spread 2. Errors over the spread: 0.2, -0.05, -0.5; the last cell is masked.
# SSE 0.2925; truth over spread 0, .05, 1: mean 0.35, SST 1.0025 - 3·0.1225 = 0.635
SQUARED, R2 = 0.2925 / 3, 0.2925 / 0.635


@pytest.mark.parametrize(
    ("kind", "error", "r2", "off_target"),
    [
        ("mse", SQUARED, 0.0, 0.0),
        ("mse-frame", 0.5 * SQUARED, 0.5 * R2, 0.0),
        # Three times the weight in the first cell alone: low, over-predicted.
        ("antighost", 0.7 * (3 * 0.04 + 0.0025 + 0.25) / 3, 0.3 * R2, 0.0),
        # The frame's force, 2.1, is low against 100 × 0.025: the first cell alone is over-predicted.
        ("antighost-frame", 0.7 * (3 * 0.04 + 0.0025 + 0.25) / 3, 0.3 * R2, 0.0),
        # The first cell alone is free (under 0.04).
        ("off-target", 0.5 * SQUARED, 0.5 * R2, 8 * 0.4 / 3 / 2.0),
    ],
)
def test_terms_by_hand(kind: str, error: float, r2: float, off_target: float) -> None:
    value = float(loss(PREDICTED, TRUE, MASK, kind, unit=4.0, spread=2.0, total=100.0))
    assert value == pytest.approx(error + r2 + off_target, rel=1e-5)
    assert torch.isfinite(loss(PREDICTED, 0 * TRUE, MASK, kind, 4.0, 2.0, 100.0)), "a batch at rest"


def test_a_frame_of_much_force_is_not_weighted() -> None:
    value = float(loss(PREDICTED, TRUE, MASK, "antighost-frame", unit=4.0, spread=2.0, total=80.0))
    assert value == pytest.approx(0.7 * SQUARED + 0.3 * R2, rel=1e-5)


def test_the_off_target_penalty_grows_from_a_quarter_to_three_quarters_of_the_run() -> None:
    off_target = [
        float(loss(PREDICTED, TRUE, MASK, "off-target", 4.0, 2.0, 100.0, progress)) - 0.5 * (SQUARED + R2)
        for progress in (0.2, 0.5, 0.75, 1.0)
    ]
    assert off_target == pytest.approx([0, off_target[3] / 2, off_target[3], off_target[3]], abs=1e-5)


def test_r2_is_that_of_torchmetrics_and_drops_with_bias() -> None:
    torch.manual_seed(0)
    true, predicted = torch.rand(2, 1, 8, 8) * 4, torch.rand(2, 1, 8, 8) * 4
    mask = torch.ones(2, 1, 8, 8)
    metric = torchmetrics.R2Score()
    metric.update(predicted.flatten(), true.flatten())
    r2 = float(1 - measure_unexplained(predicted, true, mask, 1.0))
    assert r2 == pytest.approx(float(metric.compute()), rel=1e-4)
    assert float(measure_unexplained(true + 1, true, mask, 1.0)) > 0.5


def test_r2_by_frame_weighs_weak_and_strong_frames_equally() -> None:
    torch.manual_seed(1)
    true = torch.rand(1, 1, 8, 8)
    pair = torch.cat([4 * true, 2 * true])
    ones = torch.ones(2, 1, 8, 8)
    weak = pair * torch.tensor([1.0, 0.5]).view(2, 1, 1, 1)
    strong = pair * torch.tensor([0.5, 1.0]).view(2, 1, 1, 1)
    by_frame = [
        float(measure_unexplained(predicted, pair, ones, 1.0, by_frame=True)) for predicted in (weak, strong)
    ]
    assert by_frame[0] == pytest.approx(by_frame[1], rel=1e-4)
    pooled = [float(measure_unexplained(predicted, pair, ones, 1.0)) for predicted in (weak, strong)]
    assert pooled[1] == pytest.approx(4 * pooled[0], rel=1e-4)
    single_frames = [
        float(measure_unexplained(s[None], p[None], ones[:1], 1.0)) for s, p in zip(weak, pair, strict=True)
    ]
    assert by_frame[0] == pytest.approx(sum(single_frames) / 2, rel=1e-4)


def test_the_length_of_a_zero_vector_has_a_gradient() -> None:
    predicted = torch.zeros(1, 3, 1, 2, requires_grad=True)
    true, ones = torch.zeros(1, 3, 1, 2), torch.ones(1, 1, 1, 2)
    loss(predicted, true, ones, "off-target", 4.0, 1.0, 100.0).backward()
    assert torch.isfinite(predicted.grad).all()
