"""From a gesture to the motion of the surface: load, equilibrium frame by frame, labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.fem import driven_contact, surface_embedding, tool_gesture
from synth.fem.deformation import Deformation, Volume
from synth.fem.equilibrium import solve_path
from synth.fem.law_choice import check_load
from synth.fem.material import Tissue
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.motion import Clock, TimeScheme, march_in_time, volume
from synth.fem.pulse import Pulse, lift
from synth.fem.system import System
from synth.fem.tool_gesture import Gesture, ToolMotion
from synth.geometry.triangles import Shape

_STEP_S = 0.03  # longest time step of dynamics
_TO_VTK = [0, 1, 2, 3, 4, 7, 5, 6, 8, 9]  # order of a tetrahedron's nodes in VTK
_DAMPING = 2.0  # mass-proportional, 1/s
_DENSITY_KG_M3 = 1040.0  # of grey and white matter (Barber et al., Acta Neurol. Scand. 46, 1970)


def deform(
    scheme: TimeScheme,
    tissue: Tissue,
    gestures: Sequence[Gesture],
    tets: Tets,
    surface: Shape,
    frames: int,
    fps: float,
    pulse: Pulse | None = None,
    opening_mm: float = 12.0,
    motions: Sequence[ToolMotion] = (),
    inside: bool = False,
) -> Deformation:
    """Deformation of a brain by the gestures of its instruments.

    Args:
        scheme: equilibrium or dynamics, and relaxation.
        tissue: its material.
        gestures: one per instrument, all at once; none where only the pulse moves the tissue.
        tets: the volume's mesh.
        surface: on the volume, faces counter-clockwise from outside.
        frames: T >= 2.
        fps: frames per second.
        pulse: no part of the load; moves the craniotomy of radius `opening_mm`.
        opening_mm: that radius.
        motions: of the gestures over T frames each, their own trajectories if none.
        inside: return the volume too.

    Raises:
        UserError: the load is past the law's range, or the contact is not on the surface; and as
            `equilibrium.solve_path`.
    """
    motions = motions or [tool_gesture.trajectory(gesture, frames) for gesture in gestures]
    tools = list(zip(gestures, motions, strict=True))
    area = surface_embedding.vertex_area(*surface)
    embedding = surface_embedding.embed(tets, surface.vertices)
    if any(gesture.drive for gesture in gestures):
        with _explain_error(gestures, tissue.young_kpa):
            pulse_opening = None if pulse is None else (pulse, opening_mm)
            return _deform_driven(
                scheme, tissue, tools, tets, embedding, surface, frames, fps, pulse_opening, inside
            )
    traction, load_parameter = _load(tools, tissue.law, surface.vertices, area, frames)
    # Loads for E = 1 kPa: displacement depends on force over stiffness alone.
    vertex_force = np.moveaxis(area[:, None] * traction / tissue.young_kpa, 0, -1)
    loads = np.ascontiguousarray(np.moveaxis(embedding.gather(vertex_force), -1, 0))
    system = tissue.equations(tets)
    height, uplift = np.zeros(frames), np.zeros_like(tets.points)
    if pulse is not None:
        height, uplift = pulse.height(np.arange(frames) / fps), lift(system, embedding, surface, opening_mm)
        loads += height[:, None, None] * uplift
    with _explain_error(gestures, tissue.young_kpa):
        if scheme.time == "dynamic" or scheme.relaxation:
            path = march_in_time(tets, tissue, loads, load_parameter, clock(scheme, fps, tets))
        else:
            path = solve_path(system, loads, load_parameter)
    vertex_motion = embedding.move(np.ascontiguousarray(np.moveaxis(path.displacement, 0, -1)))
    displacement = np.ascontiguousarray(np.moveaxis(vertex_motion, -1, 0))
    work = 0.5 * np.einsum("v,tvd,tvd->t", area, traction, displacement, optimize=True)
    lift_motion = embedding.move(system.solve(uplift))
    pulse_work = 0.5 * height * np.einsum("v,tvd,vd->t", area, traction, lift_motion, optimize=True)
    return Deformation(
        displacement=displacement,
        traction=traction,
        volume=_volume(tissue, system, tets, path.displacement) if inside else None,
        **_instruments(tools, surface, displacement),
        min_jacobian=path.jacobian,
        energy=path.energy * tissue.young_kpa,
        residual=path.residual,
        tool_work=work - pulse_work,
        pulse_work=pulse_work,
        cautions=(),
    )


def _deform_driven(
    scheme: TimeScheme,
    tissue: Tissue,
    tools: Sequence[tuple[Gesture, ToolMotion]],
    tets: Tets,
    embedding: surface_embedding.Embedding,
    surface: Shape,
    frames: int,
    fps: float,
    pulse_opening: tuple[Pulse, float] | None,
    inside: bool,
) -> Deformation:
    """As `deform`, by instruments that hold the tissue under them; `pulse_opening`: pulse, radius."""
    system, area = tissue.equations(tets), surface_embedding.vertex_area(*surface)
    gestures, motions = [gesture for gesture, _ in tools], [motion for _, motion in tools]
    layers = driven_contact.build_layers(gestures, tissue, embedding, surface.vertices, area)
    height, uplift = np.zeros(frames), np.zeros_like(tets.points)
    if pulse_opening is not None:
        pulse, opening_mm = pulse_opening
        height, uplift = pulse.height(np.arange(frames) / fps), lift(system, embedding, surface, opening_mm)
    time_steps, loads = clock(scheme, fps, tets), height[:, None, None] * uplift
    path = driven_contact.follow(system, tissue.young_kpa, layers, motions, time_steps, loads)
    displacement = np.stack([embedding.move(u) for u in path.displacement])
    traction, parts = np.zeros_like(displacement), np.zeros((frames, len(tools), 3))
    for t in range(frames):
        for k in np.flatnonzero(path.in_contact[t]).tolist():
            part = tissue.young_kpa * layers[k].traction(path.displacement[t], path.travel[t, k])
            traction[t] += part
            parts[t, k] = area @ part
    work = 0.5 * np.einsum("v,tvd,tvd->t", area, traction, displacement, optimize=True)
    lift_motion = embedding.move(system.solve(uplift))
    pulse_work = 0.5 * height * np.einsum("v,tvd,vd->t", area, traction, lift_motion, optimize=True)
    tips, shafts = np.zeros((frames, 2 * len(tools), 3)), np.zeros((frames, 2 * len(tools), 3))
    for number, (gesture, motion) in enumerate(tools):
        pair = slice(2 * number, 2 * number + 2)
        tips[:, pair], shafts[:, pair] = tool_gesture.pose(
            gesture, motion, surface, surface.vertices + displacement
        )
    return Deformation(
        displacement=displacement,
        traction=traction,
        force=parts.sum(axis=1),
        by_instrument=parts,
        tip=tips,
        shaft=shafts,
        min_jacobian=path.jacobian,
        energy=path.energy * tissue.young_kpa,
        residual=path.residual,
        tool_work=work - pulse_work,
        pulse_work=pulse_work,
        volume=_volume(tissue, system, tets, path.displacement) if inside else None,
    )


def _volume(tissue: Tissue, system: System, tets: Tets, displacement: Floats) -> Volume:
    stress = tissue.young_kpa * np.stack([system.cauchy(u) for u in displacement])
    return Volume(tets.points, tets.cells[:, _TO_VTK], np.asarray(displacement), stress)


@contextmanager
def _explain_error(gestures: Sequence[Gesture], young_kpa: float) -> Iterator[None]:
    """Adds force, radius and stiffness to an error of the block, whose numbers are per stiffness."""
    try:
        yield
    except UserError as error:
        contacts = [
            f"{gesture.kind} {_describe_size(gesture)}, radius {gesture.footprint_mm:.3g} mm"
            for gesture in gestures
        ]
        raise type(error)(f"{error}: {', '.join(contacts)}, E {young_kpa:.3g} kPa") from None


def _describe_size(gesture: Gesture) -> str:
    if gesture.drive is not None and gesture.drive.travel_mm is not None:
        return f"{gesture.drive.travel_mm:.3g} mm"
    return f"{gesture.force_mn:.3g} mN"


def clock(scheme: TimeScheme, fps: float, tets: Tets) -> Clock:
    """Time steps of a scheme: no longer than `_STEP_S`, a whole number per frame."""
    if scheme.time != "dynamic":
        return Clock(1 / fps, relaxation=scheme.relaxation)
    substeps = int(np.ceil(1 / fps / _STEP_S - 1e-9))
    mass = scheme.mass_kg or _DENSITY_KG_M3 * 1e-9 * volume(tets).sum()
    return Clock(1 / fps, substeps, float(mass), _DAMPING, scheme.relaxation)


def _load(
    tools: Sequence[tuple[Gesture, ToolMotion]], law: str, vertices: Floats, area: Floats, frames: int
) -> tuple[Floats, Floats]:
    """Traction (T, V, 3) kPa of all instruments, and the largest P = F/(E a^2) of one, (T,)."""
    traction, load_parameter = np.zeros((frames, *vertices.shape)), np.zeros(frames)
    for gesture, motion in tools:
        check_load(law, gesture.load, f"fem.load: {gesture.load:g} is")
        traction += tool_gesture.tractions(gesture, motion, vertices, area)
        load_parameter = np.maximum(load_parameter, gesture.load * motion.load)
    return traction, load_parameter


def _instruments(
    tools: Sequence[tuple[Gesture, ToolMotion]], surface: Shape, displacement: Floats
) -> dict[str, Floats]:
    """Force, its parts, and poses, named as in `Deformation`; `displacement` (T, V, 3) mm."""
    empty = np.zeros((len(displacement), 0, 3))
    parts, tips, shafts = [empty], [empty], [empty]
    for gesture, motion in tools:
        peak = np.sum([contact.force_mn for contact in gesture.contacts], axis=0)
        parts.append(np.outer(motion.load, peak)[:, None])
        tip, shaft = tool_gesture.pose(gesture, motion, surface, surface.vertices + displacement)
        tips.append(tip)
        shafts.append(shaft)
    by_instrument, tip, shaft = (np.concatenate(arrays, axis=1) for arrays in (parts, tips, shafts))
    return {"force": by_instrument.sum(axis=1), "by_instrument": by_instrument, "tip": tip, "shaft": shaft}
