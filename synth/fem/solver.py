"""From a gesture to the motion of the surface: load, equilibrium frame by frame, labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.fem import surface_embedding, tool_gesture
from synth.fem.equilibrium import InvertedElement, solve_path
from synth.fem.material import Tissue
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.motion import Clock, march_in_time, volume
from synth.fem.pulse import Pulse, lift
from synth.fem.tool_gesture import Gesture, ToolMotion
from synth.geometry.triangles import Shape
from synth.job import schema
from synth.job.laws import check_load

__all__ = ["Deformation", "InvertedElement", "deform"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


_STEP_S = 0.03  # longest time step of dynamics
_DAMPING = 2.0  # mass-proportional, 1/s
_DENSITY_KG_M3 = 1040.0  # of grey and white matter (Barber et al., Acta Neurol. Scand. 46, 1970)


@dataclass(frozen=True)
class Deformation:
    """The surface, its loads and the instruments over T frames, in world axes. Frame 0 is at rest."""

    rest: Floats  # (V, 3) mm
    faces: Ints  # (F, 3)
    displacement: Floats  # (T, V, 3) mm
    traction: Floats  # (T, V, 3) kPa on the surface at rest, linear on its faces
    area: Floats  # (V,) mm^2 at rest: sum(area * traction) is the force
    force: Floats  # (T, 3) mN on the tissue
    time: Floats  # (T,) s
    by_instrument: Floats  # (T, I, 3) mN, the part of each of the I instruments in it
    tip: Floats  # (T, 2 I, 3) mm, the instruments' tips, two each
    shaft: Floats  # (T, 2 I, 3) unit vectors from tip to hand
    min_jacobian: Floats  # (T,) smallest det F in the volume, at quadrature points and corners
    energy: Floats  # (T,) mN mm stored
    residual: Floats  # (T,) force out of balance over the load, in the norm of the inverse stiffness
    pulse_work: Floats  # (T,) mN mm, half of traction times the motion by the pulse alone, see `tool_work`

    @property
    def tool_work(self) -> Floats:
        """(T,) mN mm, half of traction times the motion by the instruments alone.

        Under the linear law, and without a pulse, it is the energy stored.
        """
        whole = np.einsum("v,tvd,tvd->t", self.area, self.traction, self.displacement, optimize=True)
        return np.asarray(0.5 * whole - self.pulse_work)


def deform(
    fem: schema.FemSection,
    tissue: Tissue,
    gestures: Sequence[Gesture],
    tets: Tets,
    surface: Shape,
    frames: int,
    fps: float,
    pulse: Pulse | None = None,
    opening_mm: float = schema.CraniotomySection().radius_mm,
    motions: Sequence[ToolMotion] = (),
) -> Deformation:
    """Deforms a brain by the gestures of its instruments.

    Args:
        fem: the job's section.
        tissue: stiffness and law.
        gestures: one per instrument, all at the same time.
        tets: the volume.
        surface: the fine surface on it, faces counter-clockwise from outside.
        frames: T >= 2.
        fps: 1/s.
        pulse: of heart and breath; no part of force and traction.
        opening_mm: radius of the craniotomy, where the surface is exposed to the pulse.
        motions: of the gestures, over T frames each; their own trajectories if there are none.

    Raises:
        UserError: the load is past the law's range, or the contact is not on the surface.
        InvertedElement: names frame, load and element.
        NotFinite: a displacement or an energy is not finite.
    """
    for gesture in gestures:
        check_load(tissue.law, gesture.load, f"fem.load: {gesture.load:g} is")
    motions = motions or [tool_gesture.trajectory(gesture, frames) for gesture in gestures]
    tools = list(zip(gestures, motions, strict=True))
    time, area = np.arange(frames) / fps, surface_embedding.vertex_area(*surface)
    embedding = surface_embedding.embed(tets, surface.vertices)
    traction = np.sum(
        [tool_gesture.tractions(g, moved, surface.vertices, area) for g, moved in tools], axis=0
    )
    # Loads for E = 1 kPa: displacement depends on force over stiffness alone.
    loads = np.stack([embedding.gather(area[:, None] * t) for t in traction / tissue.young_kpa])
    load_parameter = np.max([gesture.load * moved.load for gesture, moved in tools], axis=0)
    system, pulse_work = tissue.equations(tets), np.zeros(frames)
    if pulse is not None:
        height, raising = pulse.height(time), lift(system, embedding, surface, opening_mm)
        loads += height[:, None, None] * raising
        raised = embedding.move(system.solve(raising))
        pulse_work = 0.5 * height * np.einsum("v,tvd,vd->t", area, traction, raised, optimize=True)
    if fem.time == "dynamic" or fem.relaxation:
        path = march_in_time(tets, tissue, loads, load_parameter, clock(fem, fps, tets))
    else:
        path = solve_path(system, loads, load_parameter)
    displacement = np.stack([embedding.move(u) for u in path.displacement])
    poses = [tool_gesture.pose(g, moved, surface, surface.vertices + displacement) for g, moved in tools]
    forces = [np.outer(m.load, np.sum([c.force_mn for c in g.contacts], axis=0)) for g, m in tools]
    return Deformation(
        rest=surface.vertices,
        faces=surface.faces,
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
        pulse_work=pulse_work,
    )


def clock(fem: schema.FemSection, fps: float, tets: Tets) -> Clock:
    """The job's time steps: no longer than `_STEP_S`, a whole number per frame."""
    if fem.time != "dynamic":
        return Clock(1 / fps, relaxation=fem.relaxation)
    substeps = int(np.ceil(1 / fps / _STEP_S - 1e-9))
    mass = fem.mass_kg or _DENSITY_KG_M3 * 1e-9 * volume(tets).sum()
    return Clock(1 / fps, substeps, float(mass), _DAMPING, fem.relaxation)
