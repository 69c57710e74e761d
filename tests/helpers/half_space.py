"""Discs on the half-space, bare against closed forms and under a membrane against Hankel integrals."""

from typing import Any

import numpy as np
from scipy.special import ellipe, ellipk, j0, j1

from synth.arrays import Floats
from synth.fem import surface_embedding
from synth.fem.membrane import MembraneSheet
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import assemble

Row = dict[str, Any]
_RADIUS_MM = 4.5
_RINGS, _SPOKES = 60, 96
_WIDE_MM = (800.0, 800.0, 480.0)  # a membrane spreads the load: its far field is not the bare half-space's


def errors(count: int, poisson: float, sheet_mm: float = 0.0) -> list[Row]:
    """Relative root mean square errors inside the disc and outside, to twice its radius.

    `sheet_mm`: stiffness of the membrane over Young's modulus of the half-space.
    """
    a = _RADIUS_MM
    size = _WIDE_MM if sheet_mm else tetrahedra.BLOCK_MM
    tets = tetrahedra.block(count, ((0.0, 0.0, a),), size_mm=size, dome_mm=1e6)
    free = Tets(tets.points, tets.cells, tets.fixed, 0 * tets.hold)
    system = assemble(free, "linear", poisson, MembraneSheet(sheet_mm, 1.0) if sheet_mm else None)
    ring = a * np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    turn = 2 * np.pi * (np.arange(_SPOKES) + 0.5) / _SPOKES
    points = np.stack([np.outer(ring, np.cos(turn)), np.outer(ring, np.sin(turn))], axis=-1).reshape(-1, 2)
    load = surface_embedding.embed(free, np.column_stack([points, np.zeros(len(points))]))
    inside, outside = np.linspace(0.15, 0.85, 8) * a, np.linspace(1.15, 2.0, 8) * a
    rows: list[Row] = []
    for disc in ("uniform", "hertz", "tangential"):
        share = np.repeat(np.sqrt(1 - (ring / a) ** 2) if disc == "hertz" else np.ones(_RINGS), _SPOKES)
        share /= share.sum()
        direction = np.array([1.0, 0.0, 0.0] if disc == "tangential" else [0.0, 0.0, -1.0])
        fixed = free.points[free.fixed]
        shell = np.zeros_like(free.points)
        shell[free.fixed] = point_loads(fixed, points[::7], share[::7] / share[::7].sum(), direction, poisson)
        shell_force = (system.stiffness @ shell.ravel()).reshape(-1, 3)
        u = shell + system.solve(load.gather(np.outer(share, direction)) - shell_force)
        for place, radii in (("inside", inside), ("outside", outside)):
            spots = np.concatenate([np.outer(radii, [np.cos(t), np.sin(t)]) for t in turn[::6]])
            u_spots = surface_embedding.embed(free, np.column_stack([spots, np.zeros(len(spots))])).move(u)
            unit = spots / np.linalg.norm(spots, axis=1, keepdims=True)
            radial = np.einsum("nd,nd->n", u_spots[:, :2], unit)
            computed = {"u_z": -u_spots[:, 2], "u_r": radial, "u_x": u_spots[:, 0]}
            exact = (
                solve_covered(radii, a, poisson, sheet_mm, disc)
                if sheet_mm
                else solve_bare(radii, a, poisson, disc)
            )
            setting = {"tets": count, "poisson": poisson, "sheet_mm": sheet_mm, "disc": disc}
            for part, value in exact.items():
                mean = computed[part].reshape(-1, len(radii)).mean(axis=0)
                error = float(np.linalg.norm(mean - value) / np.linalg.norm(value))
                rows.append(setting | {"part": f"{part} {place}", "error": round(error, 4)})
    return rows


def solve_bare(r: Floats, a: float, poisson: float, disc: str) -> dict[str, Floats]:
    """Displacement of the surface under a unit force, E = 1 kPa (Johnson, Contact Mechanics, 3.4 and 3.6).

    Under a tangential load the kernel of point forces is [(1 - nu)/s + nu (x/s)^2/s] / (2 pi G). Its square
    averages to a half on the ring, which leaves 1 - nu/2 of the potential of which a normal load has 1 - nu.

    Args:
        r: (n,) mm from the centre.
        a: radius of the disc, mm.
        poisson: Poisson's ratio.
        disc: `uniform`, `hertz` or `tangential`.

    Returns:
        u_z down and u_r outward, or the ring's mean of u_x, (n,) mm.
    """
    sideways = -(1 - 2 * poisson) * (1 + poisson)
    if disc == "hertz":
        p = 1.5 / (np.pi * a * a)
        inside = np.pi / (4 * a) * (2 * a * a - r**2)
        reach = np.minimum(a / r, 1)
        outside = ((2 * a * a - r**2) * np.arcsin(reach) + r * a * np.sqrt(1 - reach**2)) / (2 * a)
        swept = np.where(r < a, 1 - np.clip(1 - (r / a) ** 2, 0, 1) ** 1.5, 1.0)
        down = (1 - poisson**2) * p * np.where(r < a, inside, outside)
        return {"u_z": down, "u_r": sideways * p * a * a / (3 * r) * swept}
    p = 1 / (np.pi * a * a)
    within = np.where(r < a, np.minimum(r / a, 1), np.minimum(a / r, 1)) ** 2
    outside = r * (ellipe(within) - (1 - within) * ellipk(within))
    down = 4 * (1 - poisson**2) * p / np.pi * np.where(r < a, a * ellipe(within), outside)
    if disc == "tangential":
        return {"u_x": down / (1 - poisson) * (1 - poisson / 2)}
    return {"u_z": down, "u_r": sideways * p / 2 * np.where(r < a, r, a * a / r)}


def solve_covered(r: Floats, a: float, poisson: float, sheet_mm: float, disc: str) -> dict[str, Floats]:
    """Displacement of the surface under a linear membrane of no thickness, by Hankel integrals; E = 1 kPa.

    Under a surface load t of wavenumber k the half-space moves by (1 - nu) t / (G k) along the load, normal
    or parallel to the wave vector, by (1 - 2 nu) t / (2 G k) in the other of these directions, and by
    t / (G k) under a load transverse to the wave (Johnson 2.8, 3.2, in Fourier space). The membrane carries
    4/3 S k^2 of the displacement along the wave and S k^2 / 3 of the transverse one.

    Args:
        r: (n,) mm from the centre.
        a: radius of the disc, mm.
        poisson: Poisson's ratio of the half-space.
        sheet_mm: S, stiffness of the membrane over Young's modulus of the half-space.
        disc: as in `solve_bare`.

    Returns:
        As `solve_bare`.
    """
    shear = 1 / (2 * (1 + poisson))
    k = (np.arange(400_000) + 0.5) * 2e-3 / a
    x = k * a
    load = 3 * (np.sin(x) - x * np.cos(x)) / x**3 if disc == "hertz" else 2 * j1(x) / x
    load = load / (2 * np.pi) * k * (k[1] - k[0])
    direct, cross = (1 - poisson) / (shear * k), (1 - 2 * poisson) / (2 * shear * k)
    sheet = 4 / 3 * sheet_mm * k * k
    bessel_0 = np.stack([j0(k * radius) for radius in r])
    if disc == "tangential":
        sideways = 1 / (shear * k + sheet_mm / 3 * k * k)
        return {"u_x": 0.5 * bessel_0 @ (load * (direct / (1 + direct * sheet) + sideways))}
    down = direct - cross**2 * sheet / (1 + direct * sheet)
    outward = np.stack([j1(k * radius) for radius in r]) @ (load * cross / (1 + direct * sheet))
    return {"u_z": bessel_0 @ (load * down), "u_r": -outward}


def point_loads(
    points: Floats, positions: Floats, share: Floats, direction: Floats, poisson: float
) -> Floats:
    """Displacement (N, 3) mm in a half-space z <= 0 under point forces on it (Johnson 3.2, 3.6)."""
    shear = 1 / (2 * (1 + poisson))
    u = np.zeros_like(points)
    for place, part in zip(positions, share, strict=True):
        x, y, z = points[:, 0] - place[0], points[:, 1] - place[1], -points[:, 2]
        s = np.sqrt(x * x + y * y + z * z)
        k = part / (4 * np.pi * shear)
        if direction[2]:
            ring = z / s**3 - (1 - 2 * poisson) / (s * (s + z))
            u += k * np.column_stack([ring * x, ring * y, -(2 * (1 - poisson) / s + z * z / s**3)])
        else:
            side = 1 - 2 * poisson
            depth_sum = s + z
            u += k * np.column_stack(
                [
                    1 / s + x * x / s**3 + side * (1 / depth_sum - x * x / (s * depth_sum**2)),
                    x * y / s**3 - side * x * y / (s * depth_sum**2),
                    -(x * z / s**3 + side * x / (s * depth_sum)),
                ]
            )
    return u


def press_surface(points: Floats, force: Floats, poisson: float, radius_mm: float = 3.0) -> Floats:
    """Motion (P, 3) mm of points (P, 2) mm of the surface under a force (3,) mN in x and z on a disc about
    the origin, whose pressure falls to its rim; camera axes, E = 1 kPa."""
    steps = np.linspace(-1, 1, 30)
    disc = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    share = np.maximum(1 - np.square(disc).sum(axis=1), 0)
    positions, share = radius_mm * disc[share > 0], share[share > 0] / share.sum()
    world = np.column_stack([points * [1, -1], np.full(len(points), -0.05)])
    along, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    moved = force[0] * point_loads(world, positions, share, along, poisson)
    moved += force[2] * point_loads(world, positions, share, down, poisson)
    return np.asarray(moved * [1, -1, -1], np.float64)
