"""Rigid tips: on the half-space against Sneddon, Hertz and Cattaneo; on random scenes; what they cost."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.integrate import quad

from bench.output import charts
from bench.output.result_page import Page, Section
from evidence.fem.half_space import point_loads
from evidence.fem.stability import compliance_steps, over_verify
from evidence.measuring import measuring
from synth.errors import UserError
from synth.fem import contact, surface_embedding
from synth.fem.contact import Condensed, Hold, Pose, Tip, Touch
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.solver import Deformation
from synth.fem.system import assemble
from synth.job import schema
from synth.job.law_limits import RIGID_GESTURES
from synth.job.schema import Job
from synth.sequence import pipeline, scenario

Floats = NDArray[np.float64]
Row = dict[str, Any]
_RADIUS_MM, _SKIN_MM, _POISSON, _FRICTION = 4.5, 0.18, 0.4, 0.2


@measuring(
    "--scenes 4 --tets 1600",
    said="Folder for the data.",
    file="contact.json",
    text=lambda found: str({name: found[name] for name in ("half_space", "sliding", "cost", "scenes")}),
)
def rigid(
    tets: Annotated[str, typer.Option(help="Tetrahedra of the half-space's meshes.")] = "1600,5000",
    spacing: Annotated[
        str, typer.Option(help="Of the patches, as parts of the radius, one a mesh.")
    ] = "0.17,0.15",
    scenes: Annotated[int, typer.Option(help="Random scenes of each tip.", min=1)] = 100,
    timed: Annotated[int, typer.Option(help="Of these, how many are done as a traction too.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Of the scenes.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.", min=1)] = 1,
) -> dict[str, Any]:
    """A rigid tip: depth and contact radius on the half-space, stick and slip, random scenes, cost."""
    still: list[Row] = []
    sliding: list[Row] = []
    for count, part in zip(map(int, tets.split(",")), map(float, spacing.split(",")), strict=True):
        solid = half_space(count, part)
        still += [indent(solid, name, load) | {"tets": count} for name in SHAPES for load in SHAPES[name][1]]
        sliding += [row | {"tets": count} for row in drag(solid)]
    asked = [(tip, index, seed, index < timed) for index in range(scenes) for tip in ("flat", "sphere")]
    with ProcessPoolExecutor(workers) as pool:
        rows = list(pool.map(random_scene, *zip(*asked, strict=True)))
    return {
        "half_space": still,
        "sliding": sliding,
        "cost": costs(rows),
        "scenes": [summary(tip, rows) for tip in ("flat", "sphere")],
        "rows": rows,
    }


SHAPES: dict[str, tuple[Tip, tuple[float, ...]]] = {
    "flat, edge a/20": (Tip(0.95 * _RADIUS_MM, 0.05 * _RADIUS_MM, _RADIUS_MM), (0.97, 0.98)),
    "flat, edge a/4": (Tip.named("flat", _RADIUS_MM), (0.8, 0.85)),
    "sphere 4 a": (Tip(0.0, 4 * _RADIUS_MM, _RADIUS_MM), (0.5, 0.7, 0.9)),
}
"""Tips, and the contact radii as parts of a that they are loaded to."""


def half_space(count: int, spacing: float) -> Condensed:
    """The skin of a half-space under a tip, condensed.

    A block finest under the tip; its walls move as the half-space does there under the same forces (Johnson,
    Contact Mechanics, 3.2 and 3.6), so that its size does not count.

    Args:
        count: tetrahedra.
        spacing: of the patches, as a part of the radius.
    """
    a = _RADIUS_MM
    tets = tetrahedra.block(schema.Anatomy(dome_mm=1e6), count, 2, ((0.0, 0.0, a),))
    free = Tets(tets.points, tets.cells, 2, tets.fixed, 0 * tets.hold)
    system = assemble(free, "linear", _POISSON, averaged=True)
    side = np.arange(-1.5 * a, 1.5 * a, _SKIN_MM)
    flat = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    skin = np.column_stack([flat, np.zeros(len(flat))])
    area = np.full(len(skin), _SKIN_MM**2)
    own = contact.divide(
        surface_embedding.embed(free, skin), skin, area, np.zeros((1, 2)), 1.05 * a, spacing * a
    )
    near = contact.condense(system, (own,))
    shell = _far_field(free, own.rest)
    held = (system.stiffness @ shell.reshape(-1, shell.shape[2])).reshape(shell.shape)
    far = shell - np.concatenate(
        [system.solve(part) for part in np.array_split(held, len(own.rest), axis=2)], axis=2
    )
    response = near.response + far.reshape(-1, far.shape[2]).T
    moved = np.stack([own.move(row.reshape(-1, 3)).ravel() for row in response])
    return replace(near, response=response, compliance=0.5 * (moved + moved.T))


def _far_field(tets: Tets, at: Floats) -> Floats:
    """What the walls do (N, 3, 3 P) mm under unit forces in P places (P, 3) mm."""
    out = np.zeros((len(tets.points), 3, 3 * len(at)))
    wall, one, swap = tets.points[tets.fixed], np.ones(1), [1, 0, 2]
    for i, place in enumerate(at[:, None, :2]):
        x = point_loads(wall, place, one, np.array([1.0, 0.0, 0.0]), _POISSON)
        y = point_loads(wall[:, swap], place[:, ::-1], one, np.array([1.0, 0.0, 0.0]), _POISSON)[:, swap]
        z = -point_loads(wall, place, one, np.array([0.0, 0.0, -1.0]), _POISSON)
        for k, moved in enumerate((x, y, z)):
            out[tets.fixed, :, 3 * i + k] = moved
    return out


def sneddon(tip: Tip, radius: float) -> tuple[float, float]:
    """Depth [mm] and force [mN], E = 1 kPa, at which a tip of revolution touches within a radius.

    delta = c int f'(x) / sqrt(c^2 - x^2) dx, F = 2 E* int x^2 f'(x) / sqrt(c^2 - x^2) dx (Sneddon, Int. J.
    Eng. Sci.
    3, 1965), f the tip's height; of a sphere that is flat enough, Hertz' c^2 / R and 4/3 E* c^3 / R.
    """

    def slope(x: float) -> float:
        beyond = x - tip.flat_mm
        return 0.0 if beyond <= 0 else float(beyond / np.sqrt(tip.edge_mm**2 - beyond**2))

    first = float(np.arcsin(min(tip.flat_mm / radius, 1.0)))
    depth = quad(lambda t: slope(radius * np.sin(t)), first, np.pi / 2)[0]
    force = quad(lambda t: np.sin(t) ** 2 * slope(radius * np.sin(t)), first, np.pi / 2)[0]
    return radius * depth, 2 * radius**2 * force / (1 - _POISSON**2)


def down(tip: Tip, force: float, friction: float = 0.0) -> Pose:
    """A tip over the middle, pressed straight down."""
    free = np.array([[0.0], [0.0], [-1.0]])
    return Pose(tip, friction, np.zeros(3), np.eye(3), free, np.array([force]))


def indent(solid: Condensed, name: str, part: float) -> Row:
    """Errors of depth at a given force and of the contact's radius, without friction."""
    tip, radius = SHAPES[name][0], part * _RADIUS_MM
    depth, force = sneddon(tip, radius)
    none = np.zeros_like(solid.rest)
    found = contact.touch(solid, (down(tip, force),), none, Hold.none(len(none)), (np.zeros(1),))
    pressed = -found.force[:, 2]
    # The radius by the pressure's mean square distance from the middle, which no grid of patches cuts up.
    square = ((solid.rest[:, None] + solid.offsets)[..., :2] ** 2).sum(axis=2) @ contact.SPREAD
    spread = float(pressed @ square / pressed.sum())
    return {
        "tip": name,
        "radius": part,
        "load": force / _RADIUS_MM**2,
        "depth_error": float(found.drive[0][0]) / depth - 1,
        "radius_error": (spread / mean_square(tip, radius)) ** 0.5 - 1,
    }


def mean_square(tip: Tip, radius: float) -> float:
    """Mean of r^2 [mm^2], weighted with the pressure, of a tip that touches within a radius.

    A contact that grows adds punches: each ring of load dF(c) is a flat punch's, whose mean square is 2/3 c^2
    (Mossakovskii; Jaeger, Arch. Appl. Mech. 65, 1995).
    """
    steps = np.linspace(tip.flat_mm, radius, 400)[1:]
    force = np.array([sneddon(tip, float(c))[1] for c in steps])
    middle = np.append(steps[:1], 0.5 * (steps[1:] + steps[:-1]))
    return float(np.diff(force, prepend=0.0) @ (2 / 3 * middle**2) / force[-1])


def drag(solid: Condensed, steps: int = 12) -> list[Row]:
    """A sphere pressed down and dragged aside, against Cattaneo and Mindlin (Johnson, Contact Mechanics,
    7.2).

    Displacement aside at the tangential force T: 3 mu N (2 - nu) / (16 G c) (1 - (1 - T / mu N)^(2/3)), for
    bodies that rub without moving each other up or down; ours couple a little (nu is not 1/2).
    """
    tip, radius = SHAPES["sphere 4 a"][0], 0.9 * _RADIUS_MM
    _, force = sneddon(tip, radius)
    touched, none = _pressed(solid, tip, force), np.zeros_like(solid.rest)
    shear = 1 / (2 * (1 + _POISSON))
    full = 3 * _FRICTION * force * (2 - _POISSON) / (16 * shear * radius)
    start = touched.force[:, 0].sum()
    rows = []
    for share in np.linspace(0, 1.5, steps + 1)[1:]:
        pose = replace(down(tip, force, _FRICTION), origin=np.array([share * full, 0.0, 0.0]))
        touched = contact.touch(solid, (pose,), none, touched.hold, touched.drive, touched.moved)
        away, pressing, rubbing = split(solid, pose, touched)
        on = away < 0
        got = float(touched.force[:, 0].sum() - start) / (_FRICTION * force)
        exact = float(1 - max(1 - share, 0.0) ** 1.5)
        rows.append(
            {
                "shift": float(share),
                "tangential": got,
                "exact": exact,
                "most_over_coulomb": float((rubbing[on] / (_FRICTION * pressing[on])).max()),
                "sticking": float((rubbing[on] < 0.999 * _FRICTION * pressing[on]).mean()),
                "normal_off": abs(float(touched.force[:, 2].sum()) / force + 1),
            }
        )
    return rows


def _pressed(solid: Condensed, tip: Tip, force: float, steps: int = 10) -> Touch:
    """A tip pressed down with friction, in steps."""
    none = np.zeros_like(solid.rest)
    touched = Touch(none, none, (np.zeros(1),), Hold.none(len(none)))
    for share in np.linspace(0, 1, steps + 1)[1:]:
        pose = down(tip, share * force, _FRICTION)
        touched = contact.touch(solid, (pose,), none, touched.hold, touched.drive, touched.moved)
    return touched


def split(solid: Condensed, pose: Pose, touched: Touch) -> tuple[Floats, Floats, Floats]:
    """Gap [mm], normal and tangential force [mN] of every patch, (P,) each."""
    moved = pose.origin + pose.free @ touched.drive[0]
    seen = (solid.rest + touched.moved - moved) @ pose.turn.T
    gap, normal, _ = contact.mean_gap(pose.tip, seen, solid.offsets @ pose.turn.T)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    force = touched.force @ pose.turn.T
    pressing = np.einsum("pi,pi->p", force, normal)
    return gap, pressing, np.linalg.norm(force - pressing[:, None] * normal, axis=1)


def random_scene(tip: str, index: int, seed: int, timed: bool) -> Row:
    """A push, slide or tap of the default job with a rigid tip, and `timed` as a traction too."""
    row: Row = {"index": index, "tip": tip}
    for way in ("traction", "rigid") if timed else ("rigid",):
        fem = {"gestures": RIGID_GESTURES, "contact": way, "tip": tip}
        job = Job.model_validate({"seed": seed, "sequences": 10**6, "fem": fem})
        case = scenario.draw(job, index)
        row["gesture"] = case.gesture.kind
        start = time.process_time()
        surface, tets = pipeline.build(job, case)
        built = time.process_time()
        try:
            motion = pipeline.move(job, case, surface, tets)
        except UserError as refusal:
            row[f"{way}_refused"] = str(refusal)
            continue
        done = time.process_time()
        if timed:
            row |= {f"{way}_s": round(done - built, 3), f"{way}_whole_s": round(done - start, 3)}
    if "rigid_refused" in row:
        return row
    total = np.einsum("v,tvd->td", motion.area, motion.traction)
    steps = {f"step_{name}": round(step, 3) for name, step in compliance_steps(motion).items()}
    return (
        row
        | steps
        | {
            "load": round(case.gesture.load, 4),
            "least_jacobian": round(float(motion.min_jacobian.min()), 3),
            "label_off": float(np.abs(total - motion.force).max() / np.abs(motion.force).max()),
            "over_verify": round(over_verify(motion, case, rigid=True), 3),
            "work_off": round(work_off(motion), 5),
        }
    )


def work_off(motion: Deformation) -> float:
    """What tractions have done on the surface by the last frame under load, less what is stored, over the
    most stored.

    By the trapezoidal rule over frames. Tissue is elastic: it is none, whatever is lost between tip and
    tissue.
    """
    load = motion.area[:, None] * motion.traction
    steps = [
        0.5 * float(np.vdot(load[t] + load[t - 1], motion.displacement[t] - motion.displacement[t - 1]))
        for t in range(1, len(load))
    ]
    done = np.append(0.0, np.cumsum(steps))
    return float((done - motion.energy)[-1] / motion.energy.max())


def summary(tip: str, rows: list[Row]) -> Row:
    """What became of the scenes of one tip."""
    mine = [row for row in rows if row["tip"] == tip]
    whole = [row for row in mine if "rigid_refused" not in row]
    slides = [row for row in whole if row["gesture"] == "slide"]
    return {
        "tip": tip,
        "scenes": len(mine),
        "whole": len(whole),
        "least_jacobian": min(row["least_jacobian"] for row in whole),
        "label_off": max(row["label_off"] for row in whole),
        "over_verify": max(row["over_verify"] for row in whole),
        "work_off": max(abs(row["work_off"]) for row in whole),
        "slide_step_mean": max((row["step_mean"] for row in slides), default=0.0),
        "slide_step_peak": max((row["step_peak"] for row in slides), default=0.0),
    }


def costs(rows: list[Row]) -> list[Row]:
    """CPU time of rigid contact over the traction's, of a sequence's motion and of all its mechanics with
    the mesh."""
    found = []
    for tip in ("flat", "sphere"):
        for kind in RIGID_GESTURES:
            mine = [
                r
                for r in rows
                if (r["tip"], r.get("gesture")) == (tip, kind) and "rigid_s" in r and "traction_s" in r
            ]
            if mine:
                motion, whole = (
                    [row[f"rigid{name}"] / row[f"traction{name}"] for row in mine]
                    for name in ("_s", "_whole_s")
                )
                found.append(
                    {
                        "tip": tip,
                        "gesture": kind,
                        "scenes": len(mine),
                        "motion": round(float(np.median(motion)), 2),
                        "with_mesh": round(float(np.median(whole)), 2),
                        "with_mesh_worst": round(max(whole), 2),
                    }
                )
    return found


def drawn(found: Mapping[str, Any]) -> Page:
    """What the data say."""
    panels = []
    for name, title in (
        ("depth_error", "Depth on the half-space"),
        ("radius_error", "Contact radius on the half-space"),
    ):
        curves = []
        for tip in dict.fromkeys(row["tip"] for row in found["half_space"]):
            mine = [row for row in found["half_space"] if row["tip"] == tip]
            sizes = sorted({row["tets"] for row in mine})
            worst = tuple(max(100 * abs(row[name]) for row in mine if row["tets"] == n) for n in sizes)
            curves.append(charts.Curve(tip, tuple(map(float, sizes)), worst))
        panels.append(charts.Panel(title, "tetrahedra", "worst error [%]", tuple(curves)))
    finest = max(row["tets"] for row in found["sliding"])
    fine = [row for row in found["sliding"] if row["tets"] == finest]
    shifts = tuple(row["shift"] for row in fine)
    lines = tuple(
        charts.Curve(name, shifts, tuple(row[name] for row in fine)) for name in ("tangential", "exact")
    )
    panels.append(charts.Panel("Dragged aside", "shift over Cattaneo's", "T / (mu N)", lines))
    tables = [
        Section(name, found[key])
        for name, key in (("Random scenes", "scenes"), ("Cost over traction", "cost"))
    ]
    return Page("Rigid contact", found, panels, tables)
