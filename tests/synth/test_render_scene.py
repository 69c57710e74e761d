"""The studio on every variant that runs here."""

import subprocess
import sys

import numpy as np
import pytest

from synth import llvm
from synth.errors import UserError
from synth.job import Anatomy, Job, Render
from synth.render import anatomy, camera
from synth.render.anatomy import Relief
from synth.render.camera import View
from synth.render.look import Look
from synth.render.mitsuba_adapter import cuda, pick
from synth.render.scene import Studio

VARIANTS = ["scalar_rgb", *(["llvm_ad_rgb"] if llvm.find() else []), *(["cuda_ad_rgb"] if cuda() else [])]
TIPS = np.array([[-1.0, 1.0, 0.2], [1.2, 1.4, 0.2]])
SHAFTS = np.array([[0.6, 0.3, 0.74], [0.6, 0.3, 0.74]])


def studio(variant: str, spp: int = 4, **render: object) -> tuple[Studio, np.ndarray]:
    settings = {"size": (96, 72), "spp": spp, "variant": variant, **render}
    job = Job(anatomy=Anatomy(vertices=2500), render=Render.model_validate(settings))
    surface = anatomy.procedural(Relief.draw(job.anatomy, np.random.default_rng(4)), job.anatomy)
    view = View.draw(job.render, np.random.default_rng(4))
    look = Look.draw(job, "healthy", np.random.default_rng(4))
    return Studio(surface, look, camera.place(view, job.render), job), surface.vertices


@pytest.mark.parametrize("variant", VARIANTS)
def test_same_seed_same_bytes(variant: str) -> None:
    ours, vertices = studio(variant)
    shots = [ours.frame(vertices, TIPS, SHAFTS, seed) for seed in (7, 8, 7)]
    assert (shots[0].rgb == shots[2].rgb).all()
    assert (shots[0].radiance == shots[2].radiance).all()
    assert (shots[0].rgb != shots[1].rgb).any()
    assert np.isfinite(shots[0].radiance).all()
    again, _ = studio(variant)
    assert (again.frame(vertices, TIPS, SHAFTS, 7).rgb == shots[0].rgb).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_picture_moves_with_the_truth(variant: str) -> None:
    """A sideways shift of the cortex shows in the picture where flow says, and nowhere else."""
    ours, vertices = studio(variant, spp=64, tool=False)
    rest = ours.frame(vertices, TIPS, SHAFTS, 1)
    pixel = ours.still.scale_mm_per_px
    moved = ours.frame(vertices + ours.camera.rotation[0] * 3 * pixel, TIPS, SHAFTS, 2)
    inside = np.zeros_like(ours.still.tissue)
    inside[20:-20, 30:-30] = True
    inside &= ours.still.tissue & ~rest.glare & ~np.roll(moved.glare, -3, axis=1)
    np.testing.assert_allclose(np.median(moved.flow[inside], axis=0), [3, 0], atol=0.1)
    green = [shot.rgb[..., 1].astype(float) for shot in (rest, moved)]
    errors = {d: np.abs(np.roll(green[1], -d, axis=1) - green[0])[inside].mean() for d in range(7)}
    assert min(errors, key=lambda d: errors[d]) == 3


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants_agree_pixel_by_pixel(variant: str) -> None:
    """Means of independent frames differ by no more than their standard errors say, over the picture.

    Without distortion, where no variant resamples. After Mitsuba's own z-tests of renderings.
    """
    frames = 12
    stacks = []
    for name, seed in (("scalar_rgb", 50), (variant, 90)):
        ours, vertices = studio(name, spp=16, size=(64, 48), distortion=(0.0,) * 5)
        shots = [ours.frame(vertices, TIPS, SHAFTS, seed + k) for k in range(frames)]
        stacks.append(np.stack([shot.radiance.mean(axis=2) for shot in shots]))
    one, other = stacks
    error = np.sqrt((one.var(axis=0, ddof=1) + other.var(axis=0, ddof=1)) / frames)
    z = (one.mean(axis=0) - other.mean(axis=0)) / np.maximum(error, 1e-4)
    assert abs(z.mean()) < 0.15
    assert z.std() < 1.3
    assert (np.abs(z) > 4.5).mean() < 0.01


def test_the_tool_hides_and_is_masked() -> None:
    ours, vertices = studio(VARIANTS[-1])
    shot = ours.frame(vertices, TIPS, SHAFTS, 1)
    assert 0.01 < shot.tool.mean() < 0.5
    assert not (shot.visible & shot.tool).any()
    assert not (shot.glare & shot.tool).any()
    without, _ = studio(VARIANTS[-1], tool=False)
    bare = without.frame(vertices, TIPS, SHAFTS, 1)
    assert not bare.tool.any()
    assert (bare.visible == without.still.tissue).all()


def test_traction_is_in_camera_axes() -> None:
    ours, vertices = studio(VARIANTS[-1])
    nodal = np.zeros_like(vertices)
    nodal[:, 2] = 2.0  # pulled out of the brain, towards the lens
    seen = ours.traction(nodal)[ours.still.tissue]
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 2.0, rtol=1e-5)
    assert (seen[:, 2] < -1.8).all()
    assert (ours.traction(nodal)[~ours.still.tissue] == 0).all()


def test_the_variant_is_named_or_refused() -> None:
    assert pick("scalar_rgb") == "scalar_rgb"
    assert pick("auto") == ("llvm_ad_rgb" if llvm.find() else "scalar_rgb")
    if not cuda():
        with pytest.raises(UserError, match="cuda_ad_rgb"):
            pick("cuda_ad_rgb")


def test_without_llvm_the_scalar_variant_is_taken() -> None:
    code = "from synth.render.mitsuba_adapter import pick; print(pick('auto'))"
    environment = {"PATH": "/usr/bin:/bin", "SULCUS_LLVM": ""}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "scalar_rgb"
