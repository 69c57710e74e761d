from __future__ import annotations

import pytest
import torch
from pydantic import ValidationError

from evidence.learn.cost import flops, parameters
from learn.network.d2fnet import Architecture, D2FNet, fused
from learn.network.traced import Quick
from learn.settings import PRESETS, Settings
from synth.errors import UserError


def test_the_papers_network_has_its_size() -> None:
    arch = Architecture(output="magnitude")
    with torch.device("meta"):
        count = parameters(D2FNet(arch))
    # 13.08 M in the authors' README; counted by hand, 13 083 159.
    assert count == 13_083_159
    assert flops(arch, 256) == pytest.approx(27.6e9, rel=2e-3)


def test_the_live_network_is_far_cheaper() -> None:
    assert flops(Architecture(), 256) / flops(PRESETS["live"].arch, 256) > 50


@pytest.mark.parametrize("output", ["magnitude", "vector"])
@pytest.mark.parametrize(("stem", "levels"), [(1, 3), (2, 4), (4, 2)])
@pytest.mark.parametrize("name", ["d2fnet", "unet"])
def test_shapes_mask_and_bounds(output: str, stem: int, levels: int, name: str) -> None:
    arch = Architecture(name=name, width=8, stem=stem, levels=levels, output=output)  # type: ignore[arg-type]
    torch.manual_seed(0)
    model = D2FNet(arch).eval()
    x = 50 * torch.randn(2, 5, 64, 64)
    x[:, 3] = 0
    x[:, 3, 8:40, 8:40] = 1
    with torch.no_grad():
        y = model(x)
    assert y.shape == (2, arch.components, 64, 64)
    assert torch.all(y[..., 40:, :] == 0)
    assert y[..., 8:40, 8:40].abs().max() > 0
    if name == "d2fnet":
        assert y.abs().max() <= max(arch.bounds)
        assert output == "vector" or y.min() >= 0


@pytest.mark.parametrize("name", ["d2fnet", "unet"])
def test_a_stem_with_detail_draws_at_half_the_inputs_resolution(name: str) -> None:
    torch.manual_seed(0)
    arch = Architecture(name=name, width=8, stem=4, levels=2, output="magnitude", detail=True)  # type: ignore[arg-type]
    x = torch.randn(1, 5, 64, 64)
    x[:, 3] = 1
    model = D2FNet(arch).eval()
    with torch.no_grad():
        y = model(x)
        other = x.clone()
        other[:, :2, 30:32, 30:32] += 1
        moved = (model(other) - y).abs()[0, 0]
    assert y.shape == (1, 1, 64, 64)
    assert moved[30:32, 30:32].max() > 0
    for wrong in ({"stem": 2}, {"name": "monai-unet"}):
        with pytest.raises(ValidationError, match="detail goes with a stem of 4"):
            Architecture(**{"stem": 4, "detail": True} | wrong)  # type: ignore[arg-type]


def test_every_parameter_is_reached_by_the_gradient() -> None:
    for output, stem in (("magnitude", 1), ("vector", 1), ("magnitude", 4)):
        model = D2FNet(
            Architecture(
                width=8,
                levels=2,
                stem=stem,
                detail=stem == 4,
                output=output,
                condition="film",  # type: ignore[arg-type]
            )
        )
        x = torch.randn(2, 5, 32, 32)
        x[:, 3] = 1
        model(x, torch.ones(2, 1)).square().sum().backward()
        dead = [n for n, p in model.named_parameters() if p.grad is None]
        assert not dead


def test_a_conditioned_network_starts_as_an_unconditioned_one_and_asks_for_stiffness() -> None:
    model = D2FNet(Architecture(width=8, levels=2, condition="film")).eval()
    x = torch.randn(1, 5, 32, 32)
    with torch.no_grad():
        torch.testing.assert_close(model(x, torch.zeros(1, 1)), model(x, torch.ones(1, 1)))
        model.film.weight.fill_(0.3)  # type: ignore[union-attr]
        assert not torch.allclose(model(x, torch.zeros(1, 1)), model(x, torch.ones(1, 1)))
    with pytest.raises(UserError, match="young_kpa"):
        model(x)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stem": 3}, "1, 2 or 4"),
        ({"stem": 8}, "less than or equal to 4"),
        ({"width": 6}, "multiple of 4"),
        ({"name": "vit"}, "vit"),
        ({"output": "xy"}, "xy"),
    ],
)
def test_impossible_shapes(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Architecture(**change)  # type: ignore[arg-type]


def test_an_input_that_cannot_be_halved_often_enough() -> None:
    with pytest.raises(ValidationError, match="input size 80 does not divide by 64"):
        Settings(size=80, arch=Architecture(stem=4))


def test_folding_batch_norms_changes_nothing_but_the_time() -> None:
    torch.manual_seed(0)
    model = D2FNet(Architecture(width=8, levels=2)).eval()
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_()  # type: ignore[union-attr,operator]
            module.running_var.uniform_(0.5, 2)  # type: ignore[union-attr,operator]
    quick = fused(model)
    x = torch.randn(1, 5, 32, 32)
    x[:, 3] = 1
    with torch.no_grad():
        assert model(x).abs().max() > 0
        torch.testing.assert_close(quick(x), model(x), rtol=1e-3, atol=1e-6)
    assert not any(isinstance(m, torch.nn.BatchNorm2d) for m in quick.modules())
    assert any(isinstance(m, torch.nn.BatchNorm2d) for m in model.modules())


@pytest.mark.parametrize(("condition", "total"), [("none", False), ("film", True)])
def test_the_quick_network_says_the_same_in_any_batch(condition: str, total: bool) -> None:
    torch.manual_seed(0)
    arch = Architecture(width=8, stem=4, levels=2, condition=condition, total=total)  # type: ignore[arg-type]
    model = D2FNet(arch).eval()
    quick = Quick(model, arch, 64)
    for batch in (1, 2, 3):
        x, young = torch.randn(batch, 5, 64, 64), torch.randn(batch, 1)
        x[:, 3] = 1
        with torch.no_grad():
            expected, got = model(x, young), quick(x, young)
        for a, b in zip(expected, got, strict=True) if total else [(expected, got)]:
            assert a.abs().max() > 0
            torch.testing.assert_close(b, a, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("prior", ["none", "residual"])
def test_relative_twice_the_motion_is_twice_the_force(depth: bool, prior: str) -> None:
    arch = Architecture(
        width=4, levels=2, stem=2, confidence=True, depth=depth, total=True, prior=prior, relative=True
    )
    torch.manual_seed(0)
    net = D2FNet(arch).eval()
    for head in net.heads.ranges:
        torch.nn.init.normal_(head.weight, std=0.5)
    told = torch.randn(2, arch.inputs, 32, 32)
    flags = [3, 5, 7] if depth else [3, 5]
    told[:, flags] = (torch.rand(2, len(flags), 32, 32) > 0.3).float()
    twice = told * 2
    twice[:, flags] = told[:, flags]
    with torch.no_grad():
        (one, force), (two, more) = net(told), net(twice)
    assert one.abs().max() > 0.1
    torch.testing.assert_close(two, 2 * one, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(more, 2 * force, rtol=1e-3, atol=1e-4)


def test_relative_noise_at_rest_stays_small() -> None:
    """What moves less than a hundredth of the largest motion is not blown up to it."""
    torch.manual_seed(0)
    net = D2FNet(Architecture(width=4, levels=2, stem=2, relative=True)).eval()
    for head in net.heads.ranges:
        torch.nn.init.normal_(head.weight, std=0.5)
    told = torch.randn(1, 5, 32, 32) * 1e-4
    told[:, 3] = 1
    with torch.no_grad():
        assert net(told).abs().max() < 0.06  # at most the largest bound times the least motion


def test_relative_is_not_written_by_models_that_are_not() -> None:
    assert "relative" not in Architecture().model_dump()
    assert Architecture.model_validate(Architecture(relative=True).model_dump()).relative
    with pytest.raises(ValidationError, match="relative"):
        Architecture(name="monai-unet", relative=True)
