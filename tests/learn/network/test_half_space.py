"""The physics inverse as a layer, against what an analytical load moves, and in a network."""

from __future__ import annotations

from pathlib import Path

import fake_model
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import ellipe, ellipk

from bench.methods.compliance import TO_CAMERA, Block, picture
from learn import checkpoint
from learn.data.clips import Clip
from learn.data.split import nested
from learn.evaluation.evaluate import evaluate
from learn.inference.export import export
from learn.inference.predict import load_predictor
from learn.network.d2fnet import Architecture, D2FNet
from learn.network.half_space import POISSON, SMOOTH, HalfSpace, kernel
from learn.settings import override, preset
from learn.training.train import train
from synth.errors import UserError

EXTENT, SIZE, RADIUS = 36.0, 64, 4.0
X, Y = np.meshgrid(*2 * [(np.arange(SIZE) - (SIZE - 1) / 2) * EXTENT / SIZE])
Floats = NDArray[np.float64]


def moved_by(traction: tuple[float, float, float], at: tuple[float, float]) -> Floats:
    """(3, N, N) mm on a half-space of E = 1 kPa by a uniform traction [kPa] on a disc.

    In polar coordinates about the point that moves, Boussinesq's and Cerruti's 1/r goes against the area's r:
    what is left is an integral over directions of the ray's length inside the disc. Written from Johnson,
    eq. 3.18 and 3.75.
    """
    angle = (np.arange(720) + 0.5) * np.pi / 360
    cos, sin = np.cos(angle), np.sin(angle)
    # The ray from a point goes against the way from the load to it.
    toward = (at[0] - X)[..., None] * cos + (at[1] - Y)[..., None] * sin
    apart = ((at[0] - X) ** 2 + (at[1] - Y) ** 2)[..., None]
    half = np.sqrt(np.maximum(RADIUS**2 - (apart - toward**2), 0.0))
    length = np.maximum(toward + half, 0) - np.maximum(toward - half, 0)
    shear = 1 / (2 * (1 + POISSON))
    nu, (qx, qy, p) = POISSON, traction
    along = qx * cos + qy * sin
    across = [(1 - nu) * q + nu * along * way for q, way in ((qx, cos), (qy, sin))]
    tilt = (1 - 2 * nu) / 2
    ux, uy = (a + tilt * p * way for a, way in zip(across, (cos, sin), strict=True))
    uz = (1 - nu) * p - tilt * along
    steps = np.pi / 360 / (2 * np.pi * shear)
    return np.stack([(u * length).sum(-1) * steps for u in (ux, uy, uz)])


def test_the_oracle_is_love_s() -> None:
    pressed = moved_by((0, 0, 1.0), (0.0, 0.0))
    r = np.hypot(X, Y)
    inside = r < RADIUS
    k = np.where(inside, r / RADIUS, RADIUS / r) ** 2
    outside = r / RADIUS * (ellipe(k) - (1 - k) * ellipk(k))
    love = 4 * (1 - POISSON**2) * RADIUS / np.pi * np.where(inside, ellipe(k), outside)
    np.testing.assert_allclose(pressed[2], love, rtol=0.01)
    far = np.hypot(X, Y) > 2 * RADIUS
    toward = -(1 - 2 * POISSON) * (1 + POISSON) * RADIUS**2 / 2 / r
    np.testing.assert_allclose(np.hypot(*pressed[:2])[far], -toward[far], rtol=0.02)
    assert (pressed[0] * X)[far].max() <= 1e-9, "tissue is drawn towards what presses"


@pytest.mark.parametrize("seen_mm", [100.0, 14.0])
@pytest.mark.parametrize(
    ("parts", "traction"),
    [(2, (0.6, -0.3, 0.0)), (3, (0.6, -0.3, 0.0)), (3, (0.0, 0.0, 1.0)), (3, (0.3, 0.2, 0.8))],
)
def test_a_load_is_found_again(parts: int, traction: tuple[float, float, float], seen_mm: float) -> None:
    layer = HalfSpace()
    layer.set_units(displacement_mm=0.5, extent_mm=EXTENT, traction=0.25)
    mask = np.hypot(X, Y) < seen_mm
    for at in ((0.0, 0.0), (6.0, -3.0)):
        told = torch.from_numpy(moved_by(traction, at)[None, :parts] / 0.5).float()
        said = 0.25 * layer(told, torch.from_numpy(mask[None, None]).float())[0].numpy()
        force = said.sum((1, 2)) * (EXTENT / SIZE) ** 2
        true = np.array(traction[:parts]) * np.pi * RADIUS**2
        assert np.linalg.norm(force - true) < 0.04 * np.linalg.norm(true), force / true
        assert not said[:, ~mask].any()
        size = np.linalg.norm(said, axis=0)
        place = (size * X).sum() / size.sum(), (size * Y).sum() / size.sum()
        assert np.hypot(place[0] - at[0], place[1] - at[1]) < 1.0


def test_what_is_not_seen_does_not_count() -> None:
    layer, mask = HalfSpace(), torch.from_numpy(np.hypot(X, Y) < 12)[None, None].float()
    moved = torch.from_numpy(moved_by((0.5, 0, 0), (2.0, 0))[None, :2]).float()
    assert torch.equal(layer(moved, mask), layer(torch.where(mask > 0, moved, 7.0), mask))
    assert not layer(moved, 0 * mask).any()


def test_it_is_tikhonov_s_filter() -> None:
    """Against the system solved by LAPACK on a grid of 16, where nothing is pooled."""
    n, rng = 16, np.random.default_rng(0)
    at = np.arange(n)
    apart = at[:, None] - at[None, :] + n - 1
    compliance = kernel(n, 2)[:, :, apart[:, None, :, None], apart[None, :, None, :]]
    g = compliance.transpose(0, 2, 3, 1, 4, 5).reshape(2 * n * n, -1)
    np.testing.assert_allclose(g, g.T, atol=1e-12)
    mask = rng.uniform(size=(n, n)) < 0.9
    inside = np.tile(mask.ravel(), 2)
    s = g * inside * inside[:, None]
    u = rng.normal(size=2 * n * n)
    damp = (2 * (1 + POISSON) * SMOOTH * n) ** 2
    exact = np.linalg.solve(s @ s + damp * np.eye(len(s)), s @ (u * inside)).reshape(2, n, n)
    layer = HalfSpace()
    layer.set_units(1.0, float(n), 1.0)  # cells of 1 mm
    told = torch.from_numpy(u.reshape(1, 2, n, n)).float()
    said = layer(told, torch.from_numpy(mask[None, None]).float())[0].numpy()
    assert np.linalg.norm(said - exact) < 0.01 * np.linalg.norm(exact)


@pytest.mark.parametrize("size", [16, 48, 80, 128])
def test_any_grid(size: int) -> None:
    said = HalfSpace()(torch.randn(2, 3, size, size), torch.ones(2, 1, size, size))
    assert said.shape == (2, 3, size, size)


@pytest.mark.parametrize("output", ["vector", "magnitude"])
@pytest.mark.parametrize("name", ["d2fnet", "unet"])
def test_a_network_begins_as_the_physics(output: str, name: str) -> None:
    arch = Architecture.model_validate(
        {"name": name, "width": 8, "levels": 2, "output": output, "prior": "residual", "confidence": True}
    )
    net = D2FNet(arch).eval()
    x = torch.randn(2, 6, 32, 32)
    x[:, 3] = (x[:, 3] > -1).float()
    said = net(x)
    assert net.prior is not None
    physical = net.prior(x[:, :2], x[:, 3:4])
    if output == "vector":
        assert torch.equal(said[:, :2], physical)
        assert not said[:, 2].any()
    else:
        torch.testing.assert_close(said[:, 0], physical.norm(dim=1))
    said.square().sum().backward()
    moving = [name for name, p in net.named_parameters() if p.grad is not None and p.grad.any()]
    assert any(name.startswith("heads") for name in moving), "nothing could be learnt"


def test_two_eyes_tell_it_the_third_component() -> None:
    arch = Architecture(width=8, levels=2, prior="residual", depth=True, confidence=True)
    x = torch.randn(1, 8, 32, 32)
    x[:, 3] = 1
    net = D2FNet(arch).eval()
    assert net.prior is not None
    assert torch.equal(net(x), net.prior(x[:, [0, 1, 6]], x[:, 3:4]))


def test_what_does_not_go_together() -> None:
    with pytest.raises(UserError, match="monai-unet has no prior"):
        override(preset("tiny"), ["arch.name=monai-unet", "arch.stem=1", "arch.prior=channel"])
    with pytest.raises(UserError, match="it goes with target 'density'"):
        override(preset("cpu"), ["target=intensity", "arch.prior=channel"])


@pytest.mark.slow
@pytest.mark.parametrize("prior", ["channel", "residual"])
def test_trained_read_and_exported(clips: list[Clip], tmp_path: Path, prior: str) -> None:
    changes = ["size=32", "arch.levels=2", "epochs=1", f"arch.prior={prior}"]
    settings, out = override(preset("tiny"), changes), tmp_path / "model"
    card = train(clips, nested(clips, 3, 0, seed=0), settings, out)
    assert checkpoint.read_card(out).settings.arch.prior == prior
    predictor = load_predictor(out)
    gain = dict(predictor.model.named_buffers())["prior.gain"]
    assert gain == pytest.approx(card.scales.displacement_mm / card.scales.target / settings.extent_mm)
    assert len(evaluate(predictor, clips[:1], "ideal").clips) == 1
    for kind in ("torchscript", "onnx"):
        assert export(predictor, tmp_path / kind, kind) < 1e-4
        size = (tmp_path / kind).stat().st_size - (out / "weights.pt").stat().st_size
        assert size < 1_000_000, "its constants once, not once a term"


def test_the_traced_graph_says_the_same(tmp_path: Path) -> None:
    model = fake_model.write_model(tmp_path, "arch.output=vector", "arch.prior=residual")
    rng, mask = np.random.default_rng(0), np.ones((32, 32), np.float32)
    moved = rng.normal(size=(3, 2, 32, 32)).astype(np.float32)
    plain, quick = load_predictor(model), load_predictor(model, quick=True)
    np.testing.assert_allclose(plain.density(moved, mask, 2.0), quick.density(moved, mask, 2.0), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_it_reads_what_finite_elements_move(axis: int) -> None:
    """Another solver and a body that is held below, seen through an opening: signs, axes and size."""
    block, n = Block.build("linear", 1500, 2), 32
    xy = np.stack(np.meshgrid(*2 * [(np.arange(n) - (n - 1) / 2) * EXTENT / n]), axis=-1).reshape(-1, 2)
    seen = np.hypot(*xy.T) < 14.0
    under = np.hypot(*(xy - [4.0, 2.0]).T) < RADIUS
    load = np.tile(np.eye(3)[axis] / under.sum(), (under.sum(), 1)) @ TO_CAMERA  # 1 mN
    moved = np.zeros((len(xy), 3))
    moved[seen] = picture(
        block.carry(xy[seen]), block.system.solve(block.carry(xy[under]).gather(load)), components=3
    )
    layer = HalfSpace()
    layer.set_units(1.0, EXTENT, 1.0)
    told = torch.from_numpy(moved.T.reshape(1, 3, n, n)).float()
    said = layer(told, torch.from_numpy(seen.reshape(1, 1, n, n)).float())[0].numpy()
    force = said.sum((1, 2)) * (EXTENT / n) ** 2
    # 0.48 across the view, 0.53 along it: what is held moves less than a half-space would.
    assert 0.4 < force[axis] < 0.7, force
    assert np.abs(np.delete(force, axis)).max() < 0.02, force
