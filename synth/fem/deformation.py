"""Result of the mechanics of a sequence, and its check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats, Ints
from synth.errors import UserError
from synth.fem.surface_embedding import vertex_area
from synth.geometry.triangles import Shape

_ROUNDING = 1e-6
"""Part of a quantity's largest value that passes for 0: other engines may compute in single precision."""
_LOADS = "traction", "force", "by_instrument"
_OPTIONAL = ("min_jacobian", "energy", "residual", "tool_work", "pulse_work")


@dataclass(frozen=True)
class Volume:
    """Quadratic tetrahedra under a surface over T frames, world axes."""

    points: Floats  # (N, 3) mm at rest
    cells: Ints  # (M, 10) in VTK's order
    displacement: Floats  # (T, N, 3) mm
    stress: Floats  # (T, N, 6) kPa at nodes: Cauchy's xx yy zz xy yz xz


@dataclass(frozen=True, kw_only=True)
class Deformation:
    """Motion and load of a surface of V vertices and I instruments over T frames, float64, world axes.

    Frame 0 is at rest, without load. Where no instrument is shown, I is 0. What a method does not compute is
    None: it is absent from the store, and checks that need it are skipped.
    """

    displacement: Floats
    """(T, V, 3) mm from rest."""
    traction: Floats
    """(T, V, 3) kPa on the tissue, on the surface at rest and linear on its faces. It and all forces are NaN
    where `mechanics.source` states none: sequences then have no label."""
    force: Floats
    """(T, 3) mN on the tissue: the sum of traction times the area of each vertex, a third of its faces'."""
    by_instrument: Floats
    """(T, I, 3) mN, the part of each instrument in the force."""
    tip: Floats
    """(T, 2 I, 3) mm, two tips of each instrument."""
    shaft: Floats
    """(T, 2 I, 3) unit vectors from tip to hand."""
    min_jacobian: Floats | None = None
    """(T,) smallest det F in the volume, at quadrature points and corners."""
    energy: Floats | None = None
    """(T,) mN mm stored."""
    residual: Floats | None = None
    """(T,) force out of balance over the load, in the norm of the inverse stiffness."""
    tool_work: Floats | None = None
    """(T,) mN mm, half of traction times the motion by the instruments alone: without a pulse, and under the
    linear law, the energy."""
    volume: Volume | None = None
    """The volume under the surface, where `FemMechanics` was to return it."""
    pulse_work: Floats | None = None
    """(T,) mN mm, half of traction times the motion by the pulse alone."""
    cautions: tuple[str, ...] = ()
    """What is doubtful about it, a line each; stored, and counted by `synth verify`."""


def check_deformation(
    result: Deformation, surface: Shape, frames: int, instruments: int, labelled: bool = True
) -> None:
    """Raises UserError unless a result is one of that surface, over those frames, with those instruments.

    Arrays must have the type and shape of `Deformation` and finite values; frame 0 is at rest; traction times
    area adds up to the force. Without a label (`labelled`) loads may be NaN.
    """
    if not isinstance(result, Deformation):
        raise UserError(f"mechanics: expected a Deformation, got {type(result).__name__}")
    vertex_shape = (frames, len(surface.vertices), 3)
    tip_shape = (frames, 2 * instruments, 3)
    shapes = {
        "displacement": vertex_shape,
        "traction": vertex_shape,
        "force": (frames, 3),
        "tip": tip_shape,
        "shaft": tip_shape,
    }
    shapes |= {"by_instrument": (frames, instruments, 3), **dict.fromkeys(_OPTIONAL, (frames,))}
    for name, shape in shapes.items():
        value = getattr(result, name)
        if value is None and name in _OPTIONAL:
            continue
        if not isinstance(value, np.ndarray) or value.dtype != np.float64 or value.shape != shape:
            actual = f"{getattr(value, 'dtype', type(value).__name__)} {getattr(value, 'shape', '')}".strip()
            raise UserError(f"mechanics: {name} must be float64 {shape}, not {actual}")
        if not np.isfinite(value).all() and (labelled or name not in _LOADS):
            raise UserError(f"mechanics: {name} has values that are not finite")
    for name in ("displacement", "traction", "force", "by_instrument"):
        size = np.abs(getattr(result, name))
        if size[0].max(initial=0.0) > _ROUNDING * size.max(initial=0.0):
            raise UserError(f"mechanics: {name} is not 0 in frame 0, the rest frame")
    if np.abs(np.linalg.norm(result.shaft, axis=2) - 1).max(initial=0.0) > _ROUNDING:
        raise UserError("mechanics: shaft must be unit vectors")
    area = vertex_area(*surface)
    total, size = (np.einsum("v,tvd->td", area, t) for t in (result.traction, np.abs(result.traction)))
    imbalance = np.abs(total - result.force).max(axis=1)
    if imbalance.max() > _ROUNDING * max(size.max(), np.abs(result.force).max()):
        t = int(imbalance.argmax())
        sums = f"{np.round(total[t], 4).tolist()} mN, force is {np.round(result.force[t], 4).tolist()} mN"
        raise UserError(f"mechanics: traction times area in frame {t} is {sums}")
