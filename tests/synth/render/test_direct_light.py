"""Few paths per pixel: their distribution, and noise at soft edges after filtering."""

import numpy as np
import pytest

from synth.render.mitsuba.adapter import pick
from synth.render.mitsuba.direct_light import Light, _pair
from synth.render.mitsuba.edge_filter import soften

if pick("auto") == "scalar_rgb":
    pytest.skip("no LLVM here, so nothing is compiled", allow_module_level=True)


def test_a_block_of_paths_is_spread_over_the_square() -> None:
    """A block of 4 or 16 points has one in each of as many equal rectangles, whatever their shape."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    seeds = [mi.UInt32(word) for word in (12345, 678, 91011)]
    points = np.array(_pair(dr.brev(dr.arange(mi.UInt32, 4096)), seeds)).T
    assert ((points >= 0) & (points < 1)).all()
    for size, shapes in ((4, ((2, 2), (4, 1), (1, 4))), (16, ((4, 4), (2, 8), (16, 1)))):
        for block in points.reshape(-1, size, 2):
            for shape in shapes:
                cell = np.floor(block * shape).astype(int)
                assert len({tuple(index) for index in cell}) == size


def soft_edge(size: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Share (n, n) of a straight edge that is 6 px soft, and of it what four paths a pixel find."""
    y, x = np.mgrid[:size, :size]
    exact = np.clip((0.9 * x + 0.44 * y - 0.67 * size) / 6 + 0.5, 0, 1)
    return exact, rng.binomial(4, exact) / 4


def check_denoised(exact: np.ndarray, before: list[np.ndarray], after: list[np.ndarray]) -> None:
    """Noise on the edge falls to 40% at most, without bias."""
    band = np.zeros((64, 64), bool)
    band[8:-8, 8:-8] = ((exact > 0.1) & (exact < 0.9))[8:-8, 8:-8]
    assert np.std(after, axis=0)[band].mean() < 0.4 * np.std(before, axis=0)[band].mean()
    assert abs(np.mean(after, axis=0)[band].mean()) < 0.005


def test_noise_along_a_soft_edge_falls_and_what_lies_behind_keeps_its_pixels() -> None:
    rng, zeros = np.random.default_rng(3), np.zeros((64, 64), np.float32)
    ground = np.where(np.mgrid[:64, :64][1] % 6 < 3, 0.8, 0.3).astype(np.float32)
    before, after = [], []
    for _ in range(8):
        exact, cover = soft_edge(64, rng)
        radiance = np.stack([0.1 * cover + ground * (1 - cover)] * 3).astype(np.float32)
        object_light = np.stack([0.1 * cover] * 3).astype(np.float32)
        share = cover.astype(np.float32)
        light = Light(
            radiance, object_light, share, np.zeros_like(radiance), zeros, 1 - share, 3 * share, zeros
        )
        truth = 0.1 * exact + ground * (1 - exact)
        before.append(radiance[0] - truth)
        after.append(soften(light, 4)[..., 0] - truth)
    check_denoised(exact, before, after)
    clear_pixels = np.roll(exact, (-4, -4), (0, 1))[8:-8, 8:-8] == 0  # four pixels and more from the edge
    assert np.abs(after)[:, 8:-8, 8:-8][:, clear_pixels].max() < 1e-5


def test_noise_along_a_soft_shadow_falls() -> None:
    rng, zeros = np.random.default_rng(3), np.zeros((64, 64), np.float32)
    before, after = [], []
    for _ in range(8):
        exact, shade = soft_edge(64, rng)
        blocked = np.stack([0.6 * shade] * 3).astype(np.float32)
        arrival = zeros + np.float32(2)
        light = Light(
            0.6 - blocked, 0 * blocked, zeros, blocked, 2 * shade.astype(np.float32), arrival, zeros, zeros
        )
        before.append(light.radiance[0] - 0.6 * (1 - exact))
        after.append(soften(light, 4)[..., 0] - 0.6 * (1 - exact))
    check_denoised(exact, before, after)


@pytest.mark.parametrize("spp", [4, 64])
def test_tissue_scatters_light_into_shadows_and_steel_does_not(spp: int) -> None:
    """Left half in shadow; a bar of steel across both: it stays, tissue gains most red."""
    shade = np.zeros((64, 64), np.float32)
    shade[:, :32] = 1
    steel, zeros = np.zeros_like(shade), np.zeros_like(shade)
    steel[24:40] = 1
    blocked = np.stack([0.6 * shade] * 3)
    light = Light(0.6 - blocked, 0 * blocked, zeros, blocked, shade, zeros + 1, zeros, steel)
    plain, soft = soften(light, spp), soften(light, spp, 0.1)
    np.testing.assert_array_equal(soft[25:39], plain[25:39])
    gain = (soft - plain)[8]
    assert (gain[29:32] > 0.01).all()
    assert (gain[32:35] < -0.01).all()
    assert gain[26, 0] > 1.5 * gain[26, 1] >= gain[26, 2] > 0


def test_the_outline_of_steel_is_no_row_of_beads() -> None:
    """A thin shadow beside steel, in every other pixel: evened along the outline, untouched elsewhere."""
    steel, zeros = np.zeros((64, 64), np.float32), np.zeros((64, 64), np.float32)
    steel[:, :32], steel[:, 32] = 1, 0.5
    radiance = np.stack([np.where(np.mgrid[:64, :64][1] < 32, 0.3, 0.7).astype(np.float32)] * 3)
    radiance[:, ::2, 32], radiance[:, 1::2, 32] = 0.1, 0.7
    soft = soften(Light(radiance, 0 * radiance, zeros, 0 * radiance, zeros, zeros + 1, zeros, steel), 4)
    inner = soft[8:-8, :, 0]
    assert np.ptp(inner[:, 32]) < 0.15 < np.ptp(radiance[0, 8:-8, 32])
    assert inner[:, 32].mean() == pytest.approx(0.4, abs=0.02)
    far_columns = np.r_[8:30, 35:56]
    np.testing.assert_allclose(inner[:, far_columns], radiance[0, 8:-8][:, far_columns], atol=1e-6)


def test_noise_falls_where_a_wide_rim_crosses_a_shadow() -> None:
    """Under two unequal lamps, each sampled by half of a pixel's paths; not below what texture adds."""
    rng, before, after = np.random.default_rng(5), [], []
    y, x = np.mgrid[:96, :96]
    part = np.clip((0.9 * x + 0.44 * y - 64) / 12, -1, 1)  # of the radius of confusion
    exact = 0.5 + (part * np.sqrt(1 - part**2) + np.arcsin(part)) / np.pi
    shadow = np.clip((0.7 * x + 0.7 * y - 67) / 6 + 0.5, 0, 1)
    ground = np.where(x % 6 < 3, 0.8, 0.3)
    lamp = np.array([0.4, 0.4, 1.6, 1.6])[:, None, None]  # irradiance, of each path
    for _ in range(8):
        object_paths, shadow_paths = rng.random((2, 4, 96, 96)) < np.stack([exact, shadow])[:, None]
        cover, arrival, shade = (
            part.mean(axis=0)
            for part in (object_paths, ~object_paths * lamp, (~object_paths & shadow_paths) * lamp)
        )
        parts = [0.1 * cover + ground * (arrival - shade), 0.1 * cover], [ground * shade]
        (radiance, object_), (blocked,) = ([np.stack([channel] * 3) for channel in group] for group in parts)
        planes = radiance, object_, cover, blocked, shade, arrival, 12 * cover, 0 * cover
        light = Light(*(plane.astype(np.float32) for plane in planes))
        before.append(light.radiance[0])
        after.append(soften(light, 4)[..., 0])
    band = np.zeros(exact.shape, bool)
    band[8:-8, 8:-8] = ((exact > 0.03) & (exact < 0.97))[8:-8, 8:-8]
    truth = 0.1 * exact + ground * (1 - exact) * (1 - shadow)
    for region in (band & (shadow > 0.05) & (shadow < 0.95), band & (shadow < 0.05), band & (shadow > 0.95)):
        assert np.std(after, axis=0)[region].mean() < 0.3 * np.std(before, axis=0)[region].mean()
        assert abs((np.mean(after, axis=0) - truth)[region].mean()) < 0.01
