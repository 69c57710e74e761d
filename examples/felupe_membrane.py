"""A sheet of silicone with printed speckles, inflated by suction: solved by felupe, rendered with true flow.

python examples/felupe_membrane.py folder    (twice: where felupe is installed, then where this package is)
"""

import sys
from pathlib import Path

import numpy as np
from scipy import ndimage

SHEAR_KPA, SUCTION_KPA, RIM_MM, STATES = 10.0, 0.12, 17.0, 7
JOB = {
    "sequences": 1,
    "frames": STATES,
    "fps": 10,
    "fem": {"young_kpa": 2.9 * SHEAR_KPA, "instrument": "suction"},
}
JOB["anatomy"] = {"craniotomy": {"point": (0, 0, 0), "direction": (0, 0, 1), "radius_mm": RIM_MM + 1}}


def solve(folder: Path, mm: float = 1.0, mn: float = 1.0, fine: int = 12) -> None:
    """Solves it in units of `mm` and `mn` millinewtons, and writes motion, suction and what the rim holds."""
    import felupe as fe

    low, high, n = np.array([-24, -24, -2]) / mm, np.array([24, 24, 0]) / mm, 2 * fine + 1
    mesh, kpa = fe.Cube(a=low, b=high, n=(n, n, 3)), mm**2 / mn
    rim = np.hypot(*mesh.points[:, :2].T) >= RIM_MM / mm
    field = fe.FieldContainer([fe.Field(fe.RegionHexahedron(mesh), dim=3)])
    sheet = fe.SolidBody(fe.NeoHooke(mu=SHEAR_KPA * kpa, bulk=10 * SHEAR_KPA * kpa), field)
    outer = fe.RegionHexahedronBoundary(mesh, only_surface=True, mask=~rim & (mesh.points[:, 2] == 0))
    suction = fe.SolidBodyPressure(fe.FieldContainer([fe.Field(outer, dim=3)]))
    ramp = {suction: -SUCTION_KPA * kpa * np.linspace(0, 1, STATES)[1:]}
    boundaries, states = {"rim": fe.Boundary(field[0], mask=rim)}, [[0 * mesh.points] * 3]
    for _ in fe.Step([sheet, suction], ramp, boundaries).generate(x0=field, verbose=0):
        load, inner = (body.assemble.vector(body.field).toarray().reshape(-1, 3) for body in (suction, sheet))
        states.append([field[0].values.copy(), load, rim[:, None] * inner])
    arrays = dict(zip(("displacement", "suction", "held"), np.swapaxes(states, 0, 1), strict=True))
    arrays |= {"rest": mesh.points, "hexahedra": mesh.cells, "times": 0.1 * np.arange(STATES)}
    np.savez(folder / "sheet.npz", **arrays)


def paint_speckles(rest, dark=(0.1, 0.1, 0.1), pale=(0.6, 0.6, 0.5), roughness=0.3):
    """A surface of two colours under a wet coat, and a lamp next to the camera, for a `synth.RestScene`."""
    import synth

    wave = ndimage.gaussian_filter(np.random.default_rng(7).normal(size=(512, 512)), 4)[..., None]
    share = 1 / (1 + np.exp(1 - 50 * wave))
    maps = dark + share * np.subtract(pale, dark), np.eye(3)[2] + 0 * share, 0.3 + 0 * share[..., 0]
    wet = synth.Wet(
        synth.Coat(*(texture.astype("f4") for texture in maps)), roughness, 0.3, ambient=np.full(3, 0.08)
    )
    place, power = rest.view.centre + 45 * rest.view.rotation[0], 3.6 * rest.view.translation[2] ** 2
    lamp = synth.Lamp(place, target=np.zeros(3), radius=4.0, intensity=np.full(3, power))
    return synth.SceneContent(synth.Body(*rest.shape, rest.surface.uv, wet), [lamp])


if __name__ == "__main__":
    root = Path(sys.argv[1])
    if not (root / "sheet.npz").is_file():
        sys.exit(solve(root))
    import synth  # which felupe's environment may lack

    mechanics = {"source": root / "sheet.npz", "unit_mm": 1, "unit_mn": 1, "force": "nodal:suction"}
    job = synth.Job.model_validate({**JOB, "mechanics": mechanics})
    with synth.open_dataset(root / "dataset", job) as folder:
        synth.write_scene(synth.simulate(job, content=paint_speckles), folder)
