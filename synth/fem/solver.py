"""From a gesture to the motion of the surface: load, equilibrium frame by frame, labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.fem import equilibrium, motion, surface_embedding, tool
from synth.fem.equilibrium import InvertedElement, Path
from synth.fem.material import Tissue, check_load
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.pulse import Pulse, lift
from synth.fem.tool import Gesture
from synth.job import schema

__all__ = ["Deformation", "InvertedElement", "deform"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


_STEP_S = 0.03  # of dynamics, at most
_DAMPING = 2.0  # by mass, 1/s
_DENSITY_KG_M3 = 1040.0  # of grey and white matter (Barber et al., Acta Neurol. Scand. 46, 1970)


@dataclass(frozen=True)
class Deformation:
    """The surface, its loads and the instruments over T frames, in world axes. Frame 0 is at rest."""

    rest: Floats
    """(V, 3) mm."""
    faces: Ints
    """(F, 3)."""
    displacement: Floats
    """(T, V, 3) mm."""
    traction: Floats
    """(T, V, 3) kPa on the surface at rest, linear on its faces."""
    area: Floats
    """(V,) mm^2 at rest: sum(area * traction) is the force."""
    force: Floats
    """(T, 3) mN on the tissue."""
    time: Floats
    """(T,) s."""
    by_instrument: Floats
    """(T, I, 3) mN, the part of each of the I instruments in it."""
    tip: Floats
    """(T, 2 I, 3) mm, the instruments' tips, two each."""
    shaft: Floats
    """(T, 2 I, 3) unit vectors from tip to hand."""
    min_jacobian: Floats
    """(T,) smallest det F in the volume, at quadrature points and corners."""
    energy: Floats
    """(T,) mN mm stored."""
    residual: Floats
    """(T,) force out of balance as a part of the load, both in the norm of the inverse stiffness."""
    pulse_work: Floats
    """(T,) mN mm, half of traction times what the pulse alone moves it by; see `tool_work`."""

    @property
    def tool_work(self) -> Floats:
        """(T,) mN mm, half of traction times the motion that is the tools'.

        Under the linear law, and without a pulse, it is the energy stored.
        """
        whole = np.einsum("v,tvd,tvd->t", self.area, self.traction, self.displacement, optimize=True)
        return np.asarray(0.5 * whole - self.pulse_work)


def deform(
    fem: schema.Fem,
    tissue: Tissue,
    gesture: Gesture,
    tets: Tets,
    skin_vertices: Floats,
    skin_faces: Ints,
    frames: int,
    fps: float,
    further: Sequence[Gesture] = (),
    pulse: Pulse | None = None,
    opening: schema.Craniotomy | None = None,
) -> Deformation:
    """Moves a brain as gestures ask.

    Args:
        fem: the job's section.
        tissue: stiffness and law.
        gesture: the first instrument's.
        tets: the volume.
        skin_vertices: (V, 3) mm, the fine surface.
        skin_faces: (F, 3), counter-clockwise seen from outside.
        frames: T >= 2.
        fps: 1/s.
        further: gestures of more instruments at the same time.
        pulse: of heart and breath; no part of force and traction.
        opening: where the surface is exposed to it.

    Raises:
        UserError: the load is past the law's range, or the contact is not on the surface.
        InvertedElement: names frame, load and element.
        NotFinite: a number is none.
    """
    for one in (gesture, *further):
        check_load(tissue.law, one.load)
    played = [(one, tool.course(one, frames)) for one in (gesture, *further)]
    area = surface_embedding.vertex_area(skin_vertices, skin_faces)
    carry = surface_embedding.embed(tets, skin_vertices)
    time = np.arange(frames) / fps
    height = np.zeros(frames) if pulse is None else pulse.height(time)
    traction = np.sum([tool.tractions(g, over, skin_vertices, area) for g, over in played], axis=0)
    # One load per kPa of E; displacement depends on no more than that.
    loads = np.stack([carry.gather(area[:, None] * t) for t in traction / tissue.young_kpa])
    timeless = fem.time == "quasi-static" and not fem.relaxation
    system = tissue.equations(tets) if timeless or pulse is not None else None
    raised = np.zeros_like(skin_vertices)
    if pulse is not None and system is not None:
        raising = lift(system, carry, skin_vertices, skin_faces, opening or schema.Craniotomy())
        loads += height[:, None, None] * raising
        raised = carry.move(system.solve(raising))
    named = np.max([g.load * over.load for g, over in played], axis=0)
    if system is None or not timeless:
        path = march_in_time(fem, tissue, tets, loads, named, fps)
    else:
        lean = pulse is not None or tissue.sheet is not None
        path = equilibrium.solve_path(system, loads, named, lean=lean)
    displacement = np.stack([carry.move(u) for u in path.displacement])
    surface = skin_vertices + displacement
    poses = [tool.pose(g, over, skin_vertices, skin_faces, surface) for g, over in played]
    forces = [np.outer(over.load, np.sum([c.force_mn for c in g.contacts], axis=0)) for g, over in played]
    return Deformation(
        rest=skin_vertices,
        faces=skin_faces,
        displacement=displacement,
        traction=traction,
        area=area,
        force=np.sum(forces, axis=0),
        by_instrument=np.stack(forces, axis=1),
        time=time,
        tip=np.concatenate([tip for tip, _ in poses], axis=1),
        shaft=np.concatenate([shaft for _, shaft in poses], axis=1),
        min_jacobian=path.jacobian,
        energy=path.energy * tissue.young_kpa,
        residual=path.residual,
        pulse_work=0.5 * height * np.einsum("v,tvd,vd->t", area, traction, raised, optimize=True),
    )


def march_in_time(
    fem: schema.Fem, tissue: Tissue, tets: Tets, loads: Floats, named: Floats, fps: float
) -> Path:
    """The volume in motion under (T, N, 3) mN for E = 1 kPa.

    Raises:
        As `equilibrium.solve_path`.
    """
    return motion.march_in_time(
        tets,
        tissue.law,
        tissue.poisson,
        tissue.young_kpa,
        loads,
        named,
        clock(fem, fps, tets),
        tissue.sheet,
    )


def clock(fem: schema.Fem, fps: float, tets: Tets) -> motion.Clock:
    """Steps no longer than `_STEP_S`, a whole number of them a frame."""
    dynamic = fem.time == "dynamic"
    substeps = int(np.ceil(1 / fps / _STEP_S - 1e-9)) if dynamic else 1
    mass = fem.mass_kg or _DENSITY_KG_M3 * 1e-9 * motion.volume(tets).sum()
    return motion.Clock(
        1 / fps, substeps, float(mass) if dynamic else 0.0, _DAMPING if dynamic else 0.0, fem.relaxation
    )
