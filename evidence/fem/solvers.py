"""Our solver against felupe: driven contacts, and the force estimated from felupe's motion.

`felupe_ogden.py` wrote felupe's answers, `felupe_ogden.json`: other elements (bricks of 20 nodes), another
implementation of the law, another solver.
"""

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import CloughTocher2DInterpolator

from bench.methods import large_motion
from bench.methods.compliance import TissueKind
from bench.methods.physics import GRID
from evidence import report
from evidence.study import Study
from synth.arrays import Floats
from synth.fem import driven_contact, surface_embedding
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.refine import refine
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.motion import Clock
from synth.fem.tool_gesture import Drive, Gesture, ToolContact, trajectory
from synth.geometry.triangles import Shape, grid_faces

Row = dict[str, Any]
FELUPE: Mapping[str, Any] = json.loads(Path(__file__).with_name("felupe_ogden.json").read_text("utf-8"))
"""Of `felupe_ogden.py`, E 1 kPa: `points`, `scenes`, `balls`, `openings`."""
OPENING_MM = 12.0  # of its `openings`
BLOCK_MM = 40.0, 40.0, 20.0  # of its `scenes` and `balls`


def measure(tets: int = 2400, tets_wide: int = 3200) -> Row:
    """Differences from felupe. `tets`: tetrahedra of our block; `tets_wide`: for discs of 6 mm and more."""
    return {
        "felupe": FELUPE["felupe"],
        "driven": [
            compare_driven(scene, tets if scene["radius"] < 6 else tets_wide) for scene in FELUPE["scenes"]
        ],
        "balls": [compare_ball(scene, tets) for scene in FELUPE["balls"]],
        "estimated": [compare_estimate(scene) for scene in FELUPE["openings"]],
    }


def compare_driven(scene: Mapping[str, Any], tets: int) -> Row:
    """A disc that holds the tissue and is driven: `force_error`, relative to felupe's, and `motion_error`,
    the largest at `scene["places"]` relative to the largest motion."""
    travel, reference = np.array(scene["way"]), np.array(scene["displacement"])
    places = np.array(scene["places"])
    force, motion = drive(scene["radius"], travel, scene["poisson"], scene["alpha"], places, tets)
    reaction = np.array(scene["reaction"])
    return {
        "radius_mm": scene["radius"],
        "alpha": scene["alpha"],
        "way_mm": scene["way"],
        "strength": float(np.linalg.norm(reaction) / scene["radius"] ** 2),  # P = F / (E a²)
        "force_error": float(np.linalg.norm(force - reaction) / np.linalg.norm(reaction)),
        "motion_error": float(np.abs(motion - reference).max() / np.linalg.norm(reference, axis=1).max()),
    }


def compare_ball(scene: Mapping[str, Any], tets: int = 2400) -> Row:
    """Our disc that sticks against a rigid ball without friction that touches as much: `force`, ours over
    felupe's, and `motion_error` beside it, relative to the depth, at equal force."""
    x, depth = np.array(scene["places"]), scene["depth"]
    places = np.column_stack([x, 0 * x, 0 * x])
    travel = np.array([0.0, 0.0, -depth])
    force, displacement = drive(scene["touched"], travel, scene["poisson"], scene["alpha"], places, tets)
    factor = float(force[2] / scene["reaction"][2])
    differences = np.linalg.norm(displacement / factor - scene["displacement"], axis=1)
    is_beside = x > 1.2 * scene["touched"]
    return {"depth_mm": depth, "force": factor, "motion_error": float(differences[is_beside].max() / depth)}


def compare_estimate(scene: Mapping[str, Any]) -> Row:
    """`force_error` of the vector that physics estimates from felupe's motion of the surface, relative, for a
    motion of `largest_mm` and of this `slope`."""
    axis = (np.arange(GRID.size) - (GRID.size - 1) / 2) * GRID.pitch_mm
    x, y = np.meshgrid(axis, axis)
    motion, force = motion_of(scene, x, y)
    deviation = np.full((3, *x.shape), 0.01, np.float32)
    planes = motion.transpose(2, 0, 1).astype(np.float32)
    visible_motion = large_motion.measure_motion(planes, deviation, np.hypot(x, y) < OPENING_MM, GRID)
    reaction = large_motion.reaction(
        visible_motion, TissueKind("bonded", 0.0, scene["poisson"]), OPENING_MM, scene["alpha"]
    )
    return {
        "alpha": scene["alpha"],
        "slope": float(visible_motion.slope),
        "largest_mm": float(np.linalg.norm(motion, axis=-1).max()),
        "force_error": float(np.linalg.norm(reaction - force) / np.linalg.norm(force)),
    }


@lru_cache
def flat_block(tets: int, even_mm: float) -> tuple[Tets, Shape]:
    """Felupe's block in about `tets` tetrahedra, finest within `even_mm` of its middle; a fine surface."""
    size = np.array(BLOCK_MM)
    points, cells = tetrahedra.bricks(size, 40)
    points, cells = refine(
        points, cells, lambda places: np.maximum(even_mm, np.linalg.norm(places, axis=1)), tets
    )
    points, cells = tetrahedra.with_midsides(points, cells)
    fixed = (np.abs(np.abs(points[:, :2]) - 20) < 1e-9).any(axis=1) | (points[:, 2] < 1e-9 - 20)
    x = np.linspace(-12, 12, 121)
    surface = np.stack([*np.meshgrid(x, x), np.zeros((121, 121))], axis=-1).reshape(-1, 3)
    faces = np.concatenate(grid_faces(121, 121))
    return Tets(points, cells, fixed, sp.csr_array((len(points),) * 2)), Shape(surface, faces)


def drive(
    radius_mm: float, way_mm: Floats, poisson: float, alpha: float, places: Floats, tets: int = 2400
) -> tuple[Floats, Floats]:
    """Reaction (3,) mN and motion (P, 3) mm at places (P, 3) of felupe's block, of a disc that is driven."""
    mesh, surface = flat_block(tets, 0.5 * radius_mm)
    length = float(np.linalg.norm(way_mm))
    disc = _disc(radius_mm, way_mm / length, length)
    tissue = Tissue(1.0, poisson, "ogden", alpha=alpha)
    area = surface_embedding.vertex_area(*surface)
    embedding = surface_embedding.embed(mesh, surface.vertices)
    layers = driven_contact.build_layers([disc], tissue, embedding, surface.vertices, area)
    equations, motion = tissue.equations(mesh), trajectory(disc, 3)
    path = driven_contact.follow(
        equations, 1.0, layers, [motion], Clock(1.0), np.zeros((3, *mesh.points.shape))
    )
    if not np.isclose(path.travel[1, 0], length):
        raise ValueError(f"the disc went {path.travel[1, 0]:.3g} of {length:.3g} mm")
    u = path.displacement[1]
    return layers[0].reaction(u, path.travel[1, 0]), surface_embedding.embed(mesh, places).move(u)


def _disc(radius_mm: float, direction: Floats, travel_mm: float) -> Gesture:
    x, y, z = (float(part) for part in direction)
    return Gesture(
        kind="push",
        instrument="dissector",
        contacts=(ToolContact((0.0, 0.0), (0.0, 0.0, 0.0)),),
        footprint_mm=radius_mm,
        load=0.0,
        point_mm=(0.0, 0.0),
        direction=(x, y, z),
        force_mn=0.0,
        path_mm=(0.0, 0.0),
        azimuth_deg=0.0,
        elevation_deg=50.0,
        spread_mm=1.0,
        hover_mm=8.0,
        taps=1,
        timing=(0.1, 0.4, 0.6, 0.9),
        drive=Drive(travel_mm, None, 0.0, (2 * radius_mm,) * 2),
    )


def motion_of(scene: Mapping[str, Any], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Motion (..., 3) mm at camera x, y [mm] and force (3,) mN of one of felupe's `openings`, camera axes."""
    places, displacements = np.array(scene["places"]), np.array(scene["displacement"])
    off_plane = places[:, 1] > 1e-6
    places = np.concatenate([places, places[off_plane] * [1, -1]])
    displacements = np.concatenate([displacements, displacements[off_plane] * [1, -1, 1]])
    motion = np.nan_to_num(CloughTocher2DInterpolator(places, displacements)(np.stack([x, -y], axis=-1)))
    return motion * [1, -1, -1], np.array(scene["reaction"]) * [1, -1, -1]


def page(data: Mapping[str, Any]) -> report.Page:
    """A table of each comparison, and the largest difference of each in words."""
    worst = {name: max(row["force_error"] for row in data[name]) for name in ("driven", "estimated")} | {
        "motion": max(row["motion_error"] for row in data["driven"])
    }
    driven = [
        {
            "disc's radius [mm]": row["radius_mm"],
            "Ogden's exponent": row["alpha"],
            "way [mm]": ", ".join(f"{part:g}" for part in row["way_mm"]),
            "force [mN] at E 1 kPa": row["strength"] * row["radius_mm"] ** 2,
            "F/(E a²)": row["strength"],
            "force differs by": f"{row['force_error']:.1%}",
            "motion differs by": f"{row['motion_error']:.1%}",
        }
        for row in data["driven"]
    ]
    balls = [
        {
            "depth [mm]": row["depth_mm"],
            "force over the ball's": row["force"],
            "motion beside it differs by": f"{row['motion_error']:.1%}",
        }
        for row in data["balls"]
    ]
    estimated = [
        {
            "Ogden's exponent": row["alpha"],
            "largest motion [mm]": row["largest_mm"],
            "force differs by": f"{row['force_error']:.1%}",
        }
        for row in data["estimated"]
    ]
    return report.Page(
        "An independent solver",
        data,
        (
            f"**Driven contacts differ from felupe {data['felupe']} by at most {worst['driven']:.1%} in "
            f"force and {worst['motion']:.1%} in motion; from felupe's motion physics finds its force to "
            f"{worst['estimated']:.1%}.**",
            "felupe solves the same scenes with bricks of 20 nodes, its own Ogden law and its own Newton "
            "iterations (`evidence/fem/felupe_ogden.py`); its elements are converged to 0.2% in force and "
            "0.6% in motion. Motion is relative to its largest value. Discs and balls press a bare "
            "block of 40 x 40 x 20 mm; the estimate is on one of 60 x 60 x 40 mm, held beyond 12 mm on its "
            "top as by a skull. Poisson's ratio is 0.45; there is no membrane and no relaxation. Forces are "
            "proportional to E.",
        ),
        [
            report.Section("A disc that holds the tissue and is driven", driven),
            report.Section(
                "A disc that sticks, for a rigid ball without friction",
                balls,
                ("Motion is compared at equal force.",),
            ),
            report.Section("The force that physics estimates from felupe's motion of the surface", estimated),
        ],
    )


STUDY = Study(measure, "fem/solvers/solvers.json", page, needs=("mesh", "mechanics", "score-stereo"))
