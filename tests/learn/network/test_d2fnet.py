import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from learn.network.d2fnet import BOUNDS, D2FNet
from learn.network.shape import Architecture


def test_the_published_network_has_its_size() -> None:
    arch = Architecture(output="magnitude")
    with torch.device("meta"), FlopCounterMode(display=False) as counter:
        net = D2FNet(arch).eval()
        net(torch.zeros(1, len(arch.channels), 256, 256))
        count = sum(weights.numel() for weights in net.parameters())
    # 13.08 M in the authors' README; counted by hand, 13 083 159.
    assert count == 13_083_159
    assert counter.get_total_flops() == pytest.approx(27.6e9, rel=2e-3)


@pytest.mark.parametrize("output", ["magnitude", "vector"])
@pytest.mark.parametrize(("stem", "levels"), [(1, 3), (2, 4), (4, 2)])
def test_shapes_mask_and_bounds(output: str, stem: int, levels: int) -> None:
    arch = Architecture(width=8, stem=stem, levels=levels, output=output)  # type: ignore[arg-type]
    torch.manual_seed(0)
    model = D2FNet(arch).eval()
    x = 50 * torch.randn(2, 5, 64, 64)
    x[:, 3] = 0
    x[:, 3, 8:40, 8:40] = 1
    y = model(x)
    assert y.shape == (2, arch.components, 64, 64)
    assert torch.all(y[..., 40:, :] == 0)
    assert y[..., 8:40, 8:40].abs().max() > 0
    assert y.abs().max() <= max(BOUNDS)
    assert output == "vector" or y.min() >= 0
    y.square().sum().backward()
    assert not [n for n, p in model.named_parameters() if p.grad is None]


@pytest.mark.parametrize("depth", [False, True])
def test_relative_twice_the_motion_is_twice_the_force(depth: bool) -> None:
    arch = Architecture(width=4, levels=2, stem=2, confidence=True, depth=depth, relative=True)
    torch.manual_seed(0)
    net = D2FNet(arch).eval()
    for head in net.heads.ranges:
        torch.nn.init.normal_(head.weight, std=0.5)
    x = torch.randn(2, len(arch.channels), 32, 32)
    flags = [3, 5, 7] if depth else [3, 5]
    x[:, flags] = (torch.rand(2, len(flags), 32, 32) > 0.3).float()
    doubled = x * 2
    doubled[:, flags] = x[:, flags]
    with torch.no_grad():
        force, doubled_force = net(x), net(doubled)
    assert force.abs().max() > 0.1
    torch.testing.assert_close(doubled_force, 2 * force, rtol=1e-3, atol=1e-4)
