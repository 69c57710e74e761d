"""Whether a series of another program can be soft tissue under a load: units, signs, axes, times, nodes.

A doubt doesn't stop a series: it is said when the series is read, and stored. The limits are wide, so that a
wrong factor of 1000 is outside of them and a tissue, at any rate that is filmed, is inside.
"""

from __future__ import annotations

from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from synth.arrays import Floats, Ints, Map
from synth.fem.surface_embedding import vertex_area

_LOADS = 1e-3, 10.0  # P = F / (E a^2): below, nothing is seen; above, no contact of that radius bears it
_STIFFNESS = (
    0.03,
    100.0,
)  # of load and motion over the stated E; thin layers and membranes are up to 30 times stiffer
_YOUNG_KPA = 0.01, 300.0  # of soft tissue, where E isn't stated
_SPEED_MM_S = 0.02, 500.0  # of the fastest node, from one state to the next
_ALONG = (
    0.35  # cosine between load and motion of the loaded nodes: a press and its motion are 20 degrees apart
)
_HALF_SPACE = 0.43  # E a u / F of a uniform load on a half-space, 16 (1 - nu^2) / (3 pi^2), nu = 0.45
_LEAST_WORK = 0.02  # share of the largest work below which a negative one is rounding
_LOADED, _GIVES_LESS = (
    0.3,
    0.05,
)  # share of the largest load; of the compliance under it, tissue stiffens by less
_PULLS = 0.5  # cosine between a load and the outward direction above which it pulls
_ONE_WAY, _NORMAL = 0.9, 0.9  # of a press: its total over its parts' sum; cosine to the surface's normal
_AROUND, _LEAST_NODES = (
    1.5,
    12,
)  # radii of the contact, and nodes there, whose motion along the surface is seen
_SPREADS, _MIRRORED = 0.04, 0.5  # that motion over one radius, over the depth; determinant over a mirror's
_OUT_OF_LINE, _NEAR = 0.5, 0.35  # of the length of edges: a node off its neighbours; on another's place
_MOST_NAMED = 4
_LEAST_STATES, _PATH_NODES, _WORST_STATES = 6, 300, 8  # of a path; nodes, and bends of it, that are compared
# Of a path's bends at two states, what is left when they change places; and least share of all bends that
# goes: they were exchanged.
_SMOOTHER, _ROUGHER = 0.45, 0.3


def find_permutations(
    points: Floats, faces: Ints, displacement: Map, names: Ints, files: list[Path]
) -> list[str]:
    """Doubts on nodes that change places: each of their states lies where another node should be.

    `points` (N, 3) and `displacement` (S, N, 3) in one unit; `faces` (F, 3); `names` (N,): numbers of the
    nodes in the mesh; `files`: that of each state.
    """
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    links = sp.csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    count = np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    edge = np.bincount(pairs[:, 0], length, len(points)) / count
    states, swapped_names = list[int](), set[int]()
    for k in range(1, len(displacement)):
        u = np.asarray(displacement[k], np.float64)
        deviation = np.linalg.norm(u - (links @ u) / count[:, None], axis=1)
        outliers = np.flatnonzero(deviation > _OUT_OF_LINE * edge)
        if len(outliers) < 2:
            continue
        inliers = np.ones(len(points))
        inliers[outliers] = 0.0
        inlier_count = links @ inliers
        neighbour_mean = (links @ (u * inliers[:, None])) / np.maximum(inlier_count, 1)[:, None]
        expected = points[outliers] + np.where(
            inlier_count[outliers, None] > 0, neighbour_mean[outliers], displacement[k - 1][outliers]
        )
        distance, nearest = cKDTree(expected).query(points[outliers] + u[outliers])
        swapped_nodes = outliers[(nearest != np.arange(len(outliers))) & (distance < _NEAR * edge[outliers])]
        if len(swapped_nodes) > 1:
            states.append(k)
            swapped_names |= set(names[swapped_nodes].tolist())
    if not states:
        return []
    name_list = sorted(swapped_names)
    text = ", ".join(map(str, name_list[:_MOST_NAMED])) + (" ..." if len(name_list) > _MOST_NAMED else "")
    source = "" if len(set(files)) == 1 else f" ({files[states[0]].name})"
    rest = f" and {len(states) - 1} more states" if len(states) > 1 else ""
    hint = "their numbers have to stay the same"
    return [
        f"nodes {text} change places in state {states[0]}{source}{rest}: {hint}; the motion there is false"
    ]


def find_exchanged_states(displacement: Map, time: Floats) -> list[str]:
    """A doubt on two states (S, N, 3) at rising times (S,) s that lie on a smooth path only if they change
    places."""
    count = len(displacement)
    if count < _LEAST_STATES:
        return []
    nodes = np.linspace(0, displacement.shape[1] - 1, min(displacement.shape[1], _PATH_NODES)).astype(int)
    path = np.asarray(displacement[:, nodes], np.float64).reshape(count, -1)

    def measure_bends(order: Ints, places: Ints) -> Floats:
        previous, current, following = (path[order[places + step]] for step in (-1, 0, 1))
        left_dt, right_dt = time[places] - time[places - 1], time[places + 1] - time[places]
        bend = (following - current) / right_dt[:, None] - (current - previous) / left_dt[:, None]
        return np.asarray(np.linalg.norm(bend, axis=1))

    identity, interior = np.arange(count), np.arange(1, count - 1)
    roughness = measure_bends(identity, interior)
    worst = interior[np.argsort(-roughness, kind="stable")[:_WORST_STATES]]
    candidates = np.unique(np.clip(worst[:, None] + [-1, 0, 1], 1, count - 1))
    best_change, share, pair = np.inf, 1.0, (0, 0)
    for i, j in combinations(candidates.tolist(), 2):
        neighbours = np.unique(np.clip([i - 1, i, i + 1, j - 1, j, j + 1], 1, count - 2))
        order = identity.copy()
        order[[i, j]] = j, i
        before, after = float(roughness[neighbours - 1].sum()), float(measure_bends(order, neighbours).sum())
        if after - before < best_change:
            best_change, share, pair = after - before, after / max(before, 1e-30), (i, j)
    if not (share < _SMOOTHER and best_change < -_ROUGHER * roughness.sum()):
        return []
    first, second = pair
    return [
        f"states {first} and {second} may have changed places: the motion is smooth if they are exchanged"
    ]


def find_speed_doubts(displacement: Map, time: Floats) -> list[str]:
    """Doubts on the times (S,) s of displacement (S, N, 3) mm."""
    steps = [float(np.linalg.norm(now - before, axis=1).max()) for before, now in pairwise(displacement)]
    speed = float((np.array(steps) / np.diff(time)).max())
    if _SPEED_MM_S[0] <= speed <= _SPEED_MM_S[1]:
        return []
    hint = (
        "are they in ms?"
        if speed < _SPEED_MM_S[0]
        else "are they in units longer than s, or is dt_s too small?"
    )
    summary = f"the surface moves at {speed:.2g} mm/s at most, over {time[-1]:.4g} s"
    return [f"times: {summary}; {_SPEED_MM_S[0]:g} to {_SPEED_MM_S[1]:g} mm/s are likely: {hint}"]


def find_load_doubts(
    points: Floats, faces: Ints, displacement: Map, force: Map, young_kpa: float | None
) -> list[str]:
    """Doubts on unit, sign and axes of a load.

    Args:
        points: (N, 3) mm at rest.
        faces: (F, 3).
        displacement: (S, N, 3) mm.
        force: (S, N, 3) mN on the nodes.
        young_kpa: Young's modulus; None: not stated.
    """
    size = np.linalg.norm(force, axis=2)
    k = int(size.sum(axis=1).argmax())
    f, u = np.asarray(force[k], np.float64), np.asarray(displacement[k], np.float64)
    total_mn, radius = float(size[k].sum()), contact_radius(points, faces, f)
    work, work_bound = float((f * u).sum()), float((size[k] * np.linalg.norm(u, axis=1)).sum())
    doubts, low, high = list[str](), *_LOADS
    if young_kpa is not None and not low <= (load := total_mn / (young_kpa * radius**2)) <= high:
        contact = f"a contact of {radius:.2g} mm radius and {young_kpa:g} kPa"
        what = f"{total_mn:.3g} mN on {contact} is P = {load:.2g}"
        doubts.append(f"force: {what}; {low:g} to {high:g} are likely: is mechanics.unit_mn right?")
    works = np.einsum("snd,snd->s", force, displacement, dtype=np.float64)
    if works.min() < -_LEAST_WORK * np.abs(works).max():
        state = int(works.argmin())
        doubts.append(
            f"force: does negative work, {works[state] / 2:.2g} mN mm in state {state}: it has to be "
            "what acts on the tissue, not the reaction; is its sign right?"
        )
    elif 0 < work < _ALONG * work_bound:
        angle = np.degrees(np.arccos(np.clip(work / max(work_bound, 1e-300), -1, 1)))
        doubts.append(f"force: at {angle:.0f} degrees to the motion of its nodes; are axes swapped?")
    elif work <= 0:
        doubts.append(
            f"force: {total_mn:.3g} mN act on nodes that don't move; are nodes, faces and force in one order?"
        )
    else:
        e_kpa = _HALF_SPACE * total_mn / (radius * work / total_mn)
        least, largest = _YOUNG_KPA if young_kpa is None else (limit * young_kpa for limit in _STIFFNESS)
        if not least <= e_kpa <= largest:
            label = "not stated" if young_kpa is None else f"{young_kpa:g} kPa"
            what = f"load and motion are those of a tissue of {e_kpa:.2g} kPa, fem.young_kpa is {label}"
            doubts.append(f"force: {what}: are mechanics.unit_mn, unit_mm and fem.young_kpa right?")
        loads = size.sum(axis=1, dtype=np.float64)
        compliance = works / np.maximum(loads, 1e-30) ** 2  # compliance: mean motion along the load, per load
        late_states = np.flatnonzero(
            (loads > _LOADED * total_mn) & (compliance < _GIVES_LESS * compliance[k])
        )
        if late_states.size:
            state, hint = int(late_states[0]), "have force and motion the same times?"
            doubts.append(
                f"force: {loads[state]:.3g} mN in state {state} move the tissue hardly at all; {hint}"
            )
    return doubts


def find_mirror_doubt(points: Floats, faces: Ints, displacement: Map, force: Map) -> list[str]:
    """A doubt on a motion that is mirrored along the surface, as by an axis of the other sign.

    Under a press along the normal, tissue moves towards the contact from all sides, or away on all sides: the
    gradient of the motion along the surface has a positive determinant, and mirrored a negative one. Tissue
    that hardly moves along the surface doesn't tell. Arguments as of `find_load_doubts`.
    """
    k = int(np.linalg.norm(force, axis=2).sum(axis=1).argmax())
    f, u = np.asarray(force[k], np.float64), np.asarray(displacement[k], np.float64)
    size, total = np.linalg.norm(f, axis=1), f.sum(axis=0)
    if not size.sum() > 0 or not np.linalg.norm(total) > _ONE_WAY * size.sum():
        return []
    centre, radius = (size[:, None] * points).sum(axis=0) / size.sum(), contact_radius(points, faces, f)
    is_loaded = size > 0.1 * size.max()
    normal = np.cross(*np.moveaxis(np.diff(points[faces], axis=1), 1, 0))[is_loaded[faces].any(axis=1)].sum(
        axis=0
    )
    direction = total / np.linalg.norm(total)
    if abs(direction @ normal) < _NORMAL * np.linalg.norm(normal):
        return []
    is_close = np.linalg.norm(points - centre, axis=1) < _AROUND * radius
    if is_close.sum() < _LEAST_NODES:
        return []
    tangents = np.linalg.svd(direction[None])[2][1:]  # two axes of the surface
    design = np.column_stack([(points[is_close] - centre) @ tangents.T, np.ones(is_close.sum())])
    gradient = np.linalg.lstsq(design, u[is_close] @ tangents.T, rcond=None)[0][:2]
    strain, depth = float(np.sqrt((gradient**2).sum() / 2)), float(np.abs(u[is_close] @ direction).max())
    if strain * radius < _SPREADS * depth or np.linalg.det(gradient) > -_MIRRORED * strain**2:
        return []
    return [
        "motion: tissue moves towards the contact along one axis and away from it along the other: is an "
        "axis of the displacement mirrored?"
    ]


def find_pull_doubt(force: Map, out: Floats) -> list[str]:
    """A doubt on a load (S, N, 3) mN that pulls along the outward direction `out` (3,)."""
    total = force.sum(axis=1, dtype=np.float64)
    largest = total[np.linalg.norm(total, axis=1).argmax()]
    size = float(np.linalg.norm(largest))
    if size == 0 or largest @ out <= _PULLS * size * float(np.linalg.norm(out)):
        return []
    remark = "right for forceps or suction, which fem.instrument may name"
    return [f"force: pulls the tissue outwards by {size:.3g} mN: {remark}; or is the series upside down?"]


def contact_radius(points: Floats, faces: Ints, force: Floats) -> float:
    """Radius [mm] of the disk as large as the contact of nodal forces (N, 3), by its mean pressure.

    `points`: (N, 3) mm; `faces`: (F, 3).
    """
    area, size = vertex_area(points, faces), np.linalg.norm(force, axis=1)
    square = float((np.square(size) / np.maximum(area, 1e-12)).sum())
    return float(np.sqrt(size.sum() ** 2 / max(square, 1e-300) / np.pi))


def is_rigid(points: Floats, displacement: Map) -> bool:
    """Whether displacement (N, 3) of points (N, 3) is a rigid body's, to a thousandth of its largest."""
    sample = np.linspace(0, len(points) - 1, min(len(points), 5000)).astype(int)
    rest, deformed = points[sample], points[sample] + displacement[sample]
    a, b = rest - rest.mean(axis=0), deformed - deformed.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    gap = np.linalg.norm(b - a @ rotation.T, axis=1).max()
    return bool(
        gap < max(1e-3 * np.linalg.norm(displacement, axis=1).max(), 1e-5 * np.ptp(points, axis=0).max())
    )
