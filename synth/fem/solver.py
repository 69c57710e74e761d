"""From a gesture to the motion of the surface: load, equilibrium frame by frame, labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.fem import equilibrium, indentation, motion, surface_embedding, tool
from synth.fem.equilibrium import InvertedElement, Path
from synth.fem.material import Tissue, check_load
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.pulse import Pulse, lift
from synth.fem.tool import Course, Gesture
from synth.job import schema

__all__ = ["Deformation", "InvertedElement", "deform"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Played = tuple[Gesture, Course]
"""A gesture and how it goes over the frames."""


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
    skin = indentation.Skin(surface_embedding.embed(tets, skin_vertices), skin_vertices, area)
    time = np.arange(frames) / fps
    height = np.zeros(frames) if pulse is None else pulse.height(time)
    traction = sum_tractions(
        [(g, over) for g, over in played if not indentation.applies(fem, g)], frames, skin
    )
    # One load per kPa of E; displacement depends on no more than that.
    loads = np.stack([skin.carry.gather(area[:, None] * t) for t in traction / tissue.young_kpa])
    timeless = fem.time == "quasi-static" and not fem.relaxation
    system = tissue.equations(tets) if timeless or pulse is not None else None
    raised = np.zeros_like(skin_vertices)
    if pulse is not None and system is not None:
        raising = lift(system, skin.carry, skin_vertices, skin_faces, opening or schema.Craniotomy())
        loads += height[:, None, None] * raising
        raised = skin.carry.move(system.solve(raising))
    named = np.max([g.load * over.load for g, over in played], axis=0)
    pressed = None
    if system is None or not timeless:
        path = march_in_time(fem, tissue, tets, loads, named, fps)
    elif rigid := [(g, over) for g, over in played if indentation.applies(fem, g)]:
        pressed = indentation.press_skin(fem, tissue, rigid, skin, system, loads, named)
        path, traction = pressed.path, traction + pressed.traction
    else:
        lean = pulse is not None or tissue.sheet is not None
        path = equilibrium.solve_path(system, loads, named, lean=lean)
    displacement = np.stack([skin.carry.move(u) for u in path.displacement])
    forces, tip, shaft = play_instruments(fem, played, pressed, skin, skin_faces, displacement)
    return Deformation(
        rest=skin_vertices,
        faces=skin_faces,
        displacement=displacement,
        traction=traction,
        area=area,
        force=np.sum(forces, axis=0),
        by_instrument=np.stack(forces, axis=1),
        time=time,
        tip=tip,
        shaft=shaft,
        min_jacobian=path.jacobian,
        energy=path.energy * tissue.young_kpa,
        residual=path.residual,
        pulse_work=0.5 * height * np.einsum("v,tvd,vd->t", area, traction, raised, optimize=True),
    )


def sum_tractions(played: Sequence[Played], frames: int, skin: indentation.Skin) -> Floats:
    """What gestures that are given as tractions load the skin with, (T, V, 3) kPa."""
    each = [tool.tractions(gesture, over, skin.vertices, skin.area) for gesture, over in played]
    return np.asarray(np.sum(each or [np.zeros((frames, *skin.vertices.shape))], axis=0))


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
        averaged=tissue.averaged,
    )


def play_instruments(
    fem: schema.Fem,
    played: Sequence[Played],
    pressed: indentation.Pressed | None,
    skin: indentation.Skin,
    skin_faces: Ints,
    displacement: Floats,
) -> tuple[list[Floats], Floats, Floats]:
    """What I instruments do to the skin as it moves by (T, V, 3) mm.

    Args:
        fem: the job's section.
        played: the gestures and their courses.
        pressed: what those that are rigid have found.
        skin: at rest.
        skin_faces: (F, 3).
        displacement: of the skin.

    Returns:
        Forces (T, 3) mN of each, tips (T, 2 I, 3) mm and unit vectors to the hand (T, 2 I, 3).
    """
    surface = skin.vertices + displacement
    poses = [tool.pose(g, over, skin.vertices, skin_faces, surface) for g, over in played]
    tip = np.concatenate([tip for tip, _ in poses], axis=1)
    shaft = np.concatenate([shaft for _, shaft in poses], axis=1)
    forces = [np.outer(over.load, np.sum([c.force_mn for c in g.contacts], axis=0)) for g, over in played]
    if pressed is not None:
        rigid = [k for k, (g, _) in enumerate(played) if indentation.applies(fem, g)]
        for which, k in enumerate(rigid):
            forces[k] = pressed.force[:, which]
            tip[:, 2 * k : 2 * k + 2] = tool.hover(*played[k], pressed.tips[:, which])
    return forces, tip, shaft


def clock(fem: schema.Fem, fps: float, tets: Tets) -> motion.Clock:
    """Steps no longer than `fem.dt_s`, a whole number of them a frame."""
    dynamic = fem.time == "dynamic"
    substeps = int(np.ceil(1 / fps / fem.dt_s - 1e-9)) if dynamic else 1
    mass = fem.mass_kg or fem.density_kg_m3 * 1e-9 * motion.volume(tets).sum()
    return motion.Clock(
        1 / fps, substeps, float(mass) if dynamic else 0.0, fem.damping if dynamic else 0.0, fem.relaxation
    )
