"""Presses on a block, by felupe. Run by `bench experiment foreign` in a Python that has it.

It imports nothing of ours. Reads `mechanics.json`; writes `mechanics.npz`: where the surface's nodes are, how
they move under every contact at rising shares of its force, and how with the pulse at its largest.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import felupe as fem  # type: ignore[import-not-found]
import numpy as np
from pypardiso import spsolve  # type: ignore[import-not-found]

_GROWTH = 2.5  # elements of the block's middle and top are so much finer


def main(folder: Path) -> None:
    """One specimen."""
    told = json.loads((folder / "mechanics.json").read_text("utf-8"))
    wide, deep = told["block_mm"]
    across, down = told["elements"]
    x, z = _lines(wide, deep, across, down)
    mesh = fem.mesh.Grid(x, x, z).convert(order=2, calc_points=True, calc_midfaces=True, calc_midvolumes=True)
    field = fem.FieldContainer([fem.Field(fem.RegionTriQuadraticHexahedron(mesh), dim=3)])
    young, poisson = told["young_kpa"], told["poisson"]
    law = fem.NeoHookeCompressible(
        mu=young / (2 * (1 + poisson)), lmbda=young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    )
    items: list[Any] = [fem.SolidBody(law, field)]
    top = np.flatnonzero(np.isclose(mesh.points[:, 2], 0.0))
    top = top[np.lexsort(np.round(mesh.points[top, :2], 6).T)]  # row by row
    if told["membrane_mn_per_mm"]:
        items.append(_membrane(mesh, field, top, told["membrane_mn_per_mm"]))
    moved = [_pressed(mesh, field, items, top, one, told) for one in told["contacts"]]
    pulse = _lifted(mesh, field, items, top, told["pulse_mm"], wide, deep)
    np.savez(folder / "mechanics.npz", at=mesh.points[top, :2], moved=np.array(moved), pulse=pulse)


def _lines(wide: float, deep: float, across: int, down: int) -> tuple[Any, Any]:
    """Where element borders are: finer in the middle and at the top, z = 0."""
    edge, depth = np.linspace(-1, 1, across + 1), np.linspace(0, 1, down + 1)
    x = wide / 2 * np.sign(edge) * (np.abs(edge) + (_GROWTH - 1) * np.abs(edge) ** 3) / _GROWTH
    z = -deep * (depth + (_GROWTH - 1) * depth**3) / _GROWTH
    return x, z[::-1]


def _membrane(mesh: Any, field: Any, top: Any, stiffness: float) -> Any:
    """A net of trusses over the surface's nodes: stiffness of a strip times the strip's width."""
    side = round(len(top) ** 0.5)
    net = top.reshape(side, side)
    wide = _strips(mesh.points[net[0], 0])
    rows = np.stack([net[:, :-1], net[:, 1:]], axis=-1)
    columns = np.stack([net[:-1], net[1:]], axis=-1)
    area = np.concatenate([np.repeat(wide, side - 1), np.broadcast_to(wide, (side - 1, side)).ravel()])
    cells = np.concatenate([rows.reshape(-1, 2), columns.reshape(-1, 2)])
    lines = fem.Mesh(mesh.points, cells, "line")
    strung = fem.FieldContainer([fem.Field(fem.RegionTruss(lines), dim=3)])
    strung[0].values = field[0].values  # the net moves with the block
    return fem.TrussBody(fem.LinearElastic1D(E=stiffness), strung, area=area)


def _strips(x: Any) -> Any:
    """Width that belongs to each line of nodes."""
    gap = np.diff(x)
    return np.concatenate([gap[:1] / 2, (gap[1:] + gap[:-1]) / 2, gap[-1:] / 2])


def _pressed(mesh: Any, field: Any, items: list[Any], top: Any, contact: dict[str, Any], told: Any) -> Any:
    """(levels, nodes, 3) mm at equal steps of a contact's force."""
    field[0].values[:] = 0
    free, held = _hold(field, told["block_mm"][0], told["block_mm"][1])
    at = mesh.points[top, :2]
    away = np.linalg.norm(at - contact["at_mm"], axis=1) / contact["radius_mm"]
    side = round(len(top) ** 0.5)
    line = _simpson(at[:side, 0])
    share = np.outer(line, line).ravel() * np.sqrt(np.clip(1 - away**2, 0, None))  # Hertz's pressure
    whole = np.outer(share / share.sum(), contact["force_mn"])
    out = []
    for level in np.linspace(0, 1, told["levels"] + 1)[1:]:
        load = fem.PointLoad(field, top, values=level * whole)
        fem.newtonraphson(
            items=[*items, load], dof0=held, dof1=free, ext0=np.zeros(len(held)), solver=spsolve, verbose=0
        )
        out.append(field[0].values[top].copy())
    return out


def _simpson(x: Any) -> Any:
    """Weights of an integral over a line of nodes, two to an element and one in its middle."""
    weight = np.zeros(len(x))
    for start in range(0, len(x) - 2, 2):
        weight[start : start + 3] += (x[start + 2] - x[start]) / 6 * np.array([1, 4, 1])
    return weight


def _lifted(
    mesh: Any, field: Any, items: list[Any], top: Any, lift_mm: float, wide: float, deep: float
) -> Any:
    """(nodes, 3) mm of the surface when the ground's middle is lifted until the surface rises so far."""
    if not lift_mm:
        return np.zeros((len(top), 3))
    field[0].values[:] = 0
    free, held = _hold(field, wide, deep)
    ground = np.isclose(mesh.points[:, 2], -deep)
    away = np.linalg.norm(mesh.points[:, :2], axis=1) / (wide / 2)
    rise = np.where(ground & (away < 1), np.cos(np.pi / 2 * np.clip(away, 0, 1)) ** 2, 0.0)
    fixed = np.zeros_like(mesh.points)
    fixed[:, 2] = lift_mm * rise
    fem.newtonraphson(items=items, dof0=held, dof1=free, ext0=fixed.ravel()[held], solver=spsolve, verbose=0)
    moved = field[0].values[top].copy()
    return moved * lift_mm / max(float(moved[:, 2].max()), 1e-9)


def _hold(field: Any, wide: float, deep: float) -> tuple[Any, Any]:
    """Free degrees of freedom, and those of the sides and the ground, which don't move."""
    bounds = {
        "left": fem.Boundary(field[0], fx=-wide / 2),
        "right": fem.Boundary(field[0], fx=wide / 2),
        "front": fem.Boundary(field[0], fy=-wide / 2),
        "back": fem.Boundary(field[0], fy=wide / 2),
        "ground": fem.Boundary(field[0], fz=-deep),
    }
    held, free = fem.dof.partition(field, bounds)
    return free, held


if __name__ == "__main__":
    main(Path(sys.argv[1]))
