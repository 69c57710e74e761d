"""The openings of a brain on three views of it, as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from synth.place.openings import Survey

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

_VIEWS = {"along x": (1, 2, 0, 1), "along -x": (1, 2, 0, -1), "along y": (0, 2, 1, 1)} | {
    "along -y": (0, 2, 1, -1), "along z": (0, 1, 2, 1), "along -z": (0, 1, 2, -1)
}  # fmt: skip
"""What is across, up, and away of each view, and from which side it is seen."""
_MOST_FACES = 20_000


def draw_openings(found: Survey) -> NDArray[np.uint8]:
    """(H, W, 3): the three views that show most of the chosen openings, each with its number."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    vertices, faces = thinned(found.vertices, found.faces)
    views = sorted(_VIEWS, key=lambda name: -_shown(found, name))[:3]
    figure = Figure(figsize=(12, 4.2), dpi=110)
    canvas = FigureCanvasAgg(figure)
    for axes, name in zip(figure.subplots(1, 3), views, strict=True):
        _draw(axes, found, vertices, faces, name)
    figure.suptitle(f"{found.path.name}: openings of {found.radius_mm:g} mm radius, best first")
    figure.tight_layout()
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def thinned(
    vertices: Floats, faces: NDArray[np.int64], most: int = _MOST_FACES
) -> tuple[Floats, NDArray[np.int64]]:
    """A surface to look at: vertices (V, 3) in a grid's cell become one, till few faces (F, 3) are left."""
    cell = float(np.ptp(vertices, axis=0).max()) / 400
    while len(faces) > most:
        _, group = np.unique(np.floor(vertices / cell), axis=0, return_inverse=True)
        group = group.ravel()
        size = np.bincount(group)
        middles = np.stack([np.bincount(group, vertices[:, k]) / size for k in range(3)], axis=1)
        joined = group[faces]
        joined = joined[(joined != np.roll(joined, 1, axis=1)).all(axis=1)]
        _, once = np.unique(np.sort(joined, axis=1), axis=0, return_index=True)
        if len(once) <= most:
            return middles, joined[np.sort(once)]
        cell *= 1.25
    return vertices, faces


def _shown(found: Survey, name: str) -> float:
    """How much of the chosen openings a view faces; the first count most."""
    _, _, away, sign = _VIEWS[name]
    return sum(max(sign * float(site.direction[away]), 0.0) / (k + 2) for k, site in enumerate(found.chosen))


def _draw(axes: Axes, found: Survey, vertices: Floats, faces: NDArray[np.int64], name: str) -> None:
    from matplotlib.collections import PolyCollection

    across, up, away, sign = _VIEWS[name]
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    facing = np.abs(normal[:, away]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    order = np.argsort(sign * corner[:, :, away].mean(axis=1))
    grey = 0.35 + 0.6 * facing[order, None]
    axes.add_collection(
        PolyCollection(
            list(corner[order][:, :, [across, up]]), facecolors=grey * [0.95, 0.8, 0.78], edgecolors="face"
        )
    )
    turn = np.linspace(0, 2 * np.pi, 49)
    for number, site in enumerate(found.chosen, 1):
        if sign * site.direction[away] < 0.15:
            continue  # on the far side, or edge on
        side = np.cross(site.direction, np.eye(3)[int(np.abs(site.direction).argmin())])
        side /= np.linalg.norm(side)
        other = np.cross(site.direction, side)
        ring = site.point + found.radius_mm * (np.outer(np.cos(turn), side) + np.outer(np.sin(turn), other))
        axes.plot(ring[:, across], ring[:, up], color="#0b5394", lw=1.8)
        x, y = (float(site.point[k]) for k in (across, up))
        axes.text(x, y, str(number), ha="center", va="center", weight="bold", color="#0b5394")
    axes.set(
        title=f"seen {name.replace('along', 'from')}",
        xlabel=f"{'xyz'[across]} [mm]",
        ylabel=f"{'xyz'[up]} [mm]",
    )
    axes.set_aspect("equal")
    axes.autoscale_view()
    if sign < 0:
        axes.invert_xaxis()
