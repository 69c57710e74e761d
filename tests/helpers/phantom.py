"""Small sequences from a closed form, written as stores, for training and scoring in tests.

Surface displacement of an elastic half-space under a force spread like a hat of radius a (regularised
Cerruti and Boussinesq solutions; Johnson, Contact Mechanics, 1985, §3.2), viewed from straight above.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Writer
from synth.job.schema import Job

POISSON = 0.4
SIZE = (48, 64)
SCALE_MM_PER_PX = 0.5
RADIUS_MM = 4.0
NOISE_PX = 0.05


def displacement(
    x: NDArray[np.float64], y: NDArray[np.float64], force: NDArray[np.float64], young_kpa: float
) -> NDArray[np.float64]:
    """(H, W, 2) in-plane displacement [mm] under `force` (x, y right and down, z into the tissue) [mN]."""
    rho = np.sqrt(x**2 + y**2 + RADIUS_MM**2 / 2)
    shear = (1 + POISSON) / (np.pi * young_kpa)
    fx, fy, fz = force
    ux = shear * (fx * ((1 - POISSON) / rho + POISSON * x**2 / rho**3) + fy * POISSON * x * y / rho**3)
    uy = shear * (fy * ((1 - POISSON) / rho + POISSON * y**2 / rho**3) + fx * POISSON * x * y / rho**3)
    inward = (1 - 2 * POISSON) * (1 + POISSON) / (2 * np.pi * young_kpa) * fz / rho**2
    return np.stack([ux - inward * x, uy - inward * y], axis=-1)


def depth_motion(
    x: NDArray[np.float64], y: NDArray[np.float64], force: NDArray[np.float64], young_kpa: float
) -> NDArray[np.float64]:
    """(H, W) displacement [mm] into the tissue under the same force."""
    rho = np.sqrt(x**2 + y**2 + RADIUS_MM**2 / 2)
    shear = (1 + POISSON) / (np.pi * young_kpa)
    across = (force[0] * x + force[1] * y) / rho**2
    return np.asarray(shear * ((1 - POISSON) * force[2] / rho + (1 - 2 * POISSON) / 2 * across))


def write(
    folder: Path,
    index: int,
    *,
    anatomy_seed: int,
    frames: int = 6,
    recovered: bool = True,
    family: str = "healthy",
    stereo: bool = False,
    opening: str | None = None,
) -> Path:
    """One sequence: a contact somewhere, a direction, a ramp up to a peak; deterministic in `index`."""
    rng = np.random.default_rng([7, index])
    job = Job(
        frames=frames,
        flow={"backend": "opencv-tvl1" if recovered else "ideal"},  # type: ignore[arg-type]
        render={"stereo_mm": 24.0 if stereo else 0.0},  # type: ignore[arg-type]
        store={"without": ("flow_right", "visible_right", "depth_right") if stereo else ()},  # type: ignore[arg-type]
    )
    rows, cols = SIZE
    young = float(np.exp(rng.uniform(np.log(0.5), np.log(3.0))))
    contact = rng.uniform(-4, 4, 2)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    peak = rng.uniform(0.02, 0.12) * young * RADIUS_MM**2 * direction
    x = (np.arange(cols) - (cols - 1) / 2) * SCALE_MM_PER_PX - contact[0]
    y = (np.arange(rows) - (rows - 1) / 2) * SCALE_MM_PER_PX - contact[1]
    gx, gy = np.meshgrid(x, y)
    tissue = (gx + contact[0]) ** 2 + (gy + contact[1]) ** 2 < 11.0**2
    area = np.full(SIZE, SCALE_MM_PER_PX**2, np.float32)
    ramp = np.sin(np.linspace(0, np.pi, frames)).clip(0)
    writer = Writer(folder, index, frames=frames, size=SIZE, job=job)
    writer.put("time", np.arange(frames) / 25.0)
    writer.put("force", ramp[:, None] * peak)
    writer.put("tissue", tissue)
    writer.put("area", area)
    writer.put("disparity", np.zeros(SIZE, np.float32))
    share = (1 - np.minimum((gx**2 + gy**2) / RADIUS_MM**2, 1)) ** 2  # (1 − r²/a²)² inside the contact
    share /= (share * area).sum()
    picture = np.random.default_rng(index).integers(60, 120, (*SIZE, 3), dtype=np.uint8)
    for t, level in enumerate(ramp):
        flow = displacement(gx, gy, level * peak, young) / SCALE_MM_PER_PX * tissue[..., None]
        writer.put_frame("rgb", t, np.roll(picture, t, axis=1))
        writer.put_frame("flow", t, flow.astype(np.float32))
        writer.put_frame("visible", t, tissue)
        writer.put_frame("tool", t, np.zeros(SIZE, bool))
        writer.put_frame("glare", t, np.zeros(SIZE, bool))
        writer.put_frame("depth", t, np.full(SIZE, 300.0, np.float32))
        writer.put_frame("traction", t, (share[..., None] * level * peak).astype(np.float32))
        if recovered:
            noisy = flow + NOISE_PX * rng.normal(size=flow.shape) * tissue[..., None]
            writer.put_frame("flow_recovered", t, noisy.astype(np.float32))
            writer.put_frame("flow_confidence", t, np.full(SIZE, 0.8, np.float32))
        if stereo:
            depth = depth_motion(gx, gy, level * peak, young)[..., None] * tissue[..., None]
            motion = np.concatenate([flow * SCALE_MM_PER_PX, depth], axis=-1)
            writer.put_frame("motion", t, motion.astype(np.float32))
            noise = 0.02 * rng.normal(size=motion.shape) * tissue[..., None]
            writer.put_frame("motion_recovered", t, (motion + noise).astype(np.float32))
            spread = np.array([0.02, 0.02, 0.04], np.float32) * tissue[..., None]
            writer.put_frame("motion_deviation", t, spread.astype(np.float32))
            writer.put_frame("rgb_right", t, np.roll(picture, t, axis=1))
    return writer.seal(
        scenario={"family": family, "gestures": [{"kind": "pull"}]},
        scale_mm_per_px=SCALE_MM_PER_PX,
        young_kpa=young,
        poisson=POISSON,
        anatomy_id=f"seed-{anatomy_seed}" if opening is None else opening.partition(" at ")[0],
        **({} if opening is None else {"opening_id": opening}),
    )
