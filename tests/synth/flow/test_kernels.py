"""Compiled loops against whole-tensor code."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tensor_tvl1 import solve_level

from evidence.flow.scenes import noise_field
from synth.flow import image, tvl1
from synth.flow.image import Level
from synth.flow.tvl1 import Tvl1, TVL1Settings


@pytest.mark.parametrize(
    ("shape", "settings"),
    [((96, 128), TVL1Settings()), ((75, 101), TVL1Settings(noise=0.0, median=False))],
)
def test_flow_equals_that_of_the_tensor_code(
    shape: tuple[int, int], settings: TVL1Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    grey = 120 + 30 * sum(noise_field(shape, period, rng) for period in (4, 12, 40))
    rest = np.clip(grey, 0, 255).astype(np.uint8)[..., None].repeat(3, -1)
    now = np.roll(rest, (2, -3), (0, 1))
    usable, now_usable = np.ones(shape, bool), np.ones(shape, bool)
    usable[20:40, 30:60] = False
    now_usable[:15, :25] = False
    initial = rng.normal(0, 0.3, (*shape, 2)).astype(np.float32) + np.float32([-3, 2])
    estimator = Tvl1(settings)
    for start in (None, initial):
        found = estimator.flow(rest, now, usable, now_usable, start)
        with monkeypatch.context() as patched:
            patched.setattr(tvl1, "_solve_level", solve_level)
            plain = estimator.flow(rest, now, usable, now_usable, start)
        assert np.abs(found[0] - plain[0]).max() < 1e-3
        assert np.abs(found[1] - plain[1]).max() < 1e-3
        assert np.abs(plain[0]).max() > 2, "without motion nothing is compared"


@pytest.mark.parametrize("shape", [(8, 12), (9, 13), (2, 3)])
def test_means_equal_those_of_pytorch(shape: tuple[int, int]) -> None:
    field = torch.randn(2, 3, *shape, generator=torch.Generator().manual_seed(1))
    expected = F.avg_pool2d(field, 2, ceil_mode=True, count_include_pad=False)
    torch.testing.assert_close(image.halved(field), expected, rtol=1e-5, atol=1e-6)
    for radius in (1, 3):
        wide = 2 * radius + 1
        rows = F.avg_pool2d(field, (1, wide), 1, (0, radius), count_include_pad=False)
        expected = F.avg_pool2d(rows, (wide, 1), 1, (radius, 0), count_include_pad=False)
        torch.testing.assert_close(image.box(field, radius), expected, rtol=1e-5, atol=1e-6)


def test_a_diverged_flow_samples_at_the_border() -> None:
    now = torch.arange(20.0).view(1, 1, 4, 5)
    flow = torch.full((1, 2, 4, 5), 1e9)
    level = Level(now, now, torch.ones_like(now), torch.ones_like(now))
    assert torch.isfinite(tvl1.solve([level], flow, TVL1Settings(warps=1, median=False))).all()
