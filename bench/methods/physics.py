"""Physics as a method: `posterior` on every frame, with tissue parameters weighted by the whole video.

At its end spans without contact give the tissue's own motion, the frames with the largest motion its edge,
membrane and Poisson's ratio; a force map requested earlier uses the frame with the largest motion so far.
Where the surface is bent beyond the linear range, some frames are then solved by `large_motion`; those
between them take the gain over the linear force that these show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import log_softmax, softmax

from bench.methods import compliance, large_motion, load_window, posterior, relaxation
from bench.methods.compliance import OPENING_MM, Edge, TissueKind
from bench.methods.force_mixture import mix, size_interval
from bench.methods.large_motion import SeenMotion
from bench.methods.method_interface import (
    Field,
    ForceEstimate,
    FrameMotion,
    MethodContext,
    widen_small_forces,
)
from bench.methods.posterior import LoadBasis, Observation, Posterior
from learn.data.clips import UNKNOWN_YOUNG_KPA
from learn.data.grid import Grid, GridView, to_image
from synth.arrays import Floats, Ints, Map, Mask
from synth.fem.equilibrium import ExcessiveLoad
from synth.flow.confidence import deviation
from synth.flow.recording.find_tissue import measure_border_share

GRID = Grid(48)
_MOVING_MM = (
    0.4  # least motion that moves a window, beyond the tissue's own: flow errs as much at instruments
)

Offset = tuple[int, int]
"""Of the middle of a frame's loads from the tissue's, in nodes along x and y."""


@dataclass(frozen=True)
class TissueConstants:
    """Candidate tissues and constants of their weights; by hand where no source is given."""

    membranes_mm: tuple[float, ...] = (0.0, 5.0, 15.0, 40.0, 100.0, 250.0)  # stiffness over E
    stretches: tuple[float, ...] = (1.0, 1.02)  # of a membrane at rest; in vivo 1 to 3% (design.md)
    intact: float = 0.33  # prior probability of a membrane
    stiff_mn_per_mm: float = 35.0
    """Median of its stiffness: 0.05 to 0.2 mm of 100 to 1000 kPa (`MembraneSection`)."""
    stiffer: float = 1.0  # deviation of that stiffness' logarithm
    doubt: float = 2.0
    """Largest difference of log evidence between stiffnesses, and between Poisson's ratios: strong loads
    differ from the model's, and by their evidence a membrane is 3 to 20 times softer than it is."""
    shown: int = 3  # stiffnesses in a posterior, the likeliest
    poisson: tuple[float, ...] = (0.45, 0.4, 0.49)  # most likely first
    cut: float = 0.25  # share of its outline on the picture's border, from which tissue's edge is unknown
    wide: float = 1.2  # radius of the visible tissue, in openings, above which no skull edge is assumed
    temper: float = 0.1  # share of the evidence that counts: errors are correlated (design.md)
    strongest: int = 8  # frames that weight the tissues, every third
    growth: float = 1.3  # motion relative to the last weighting's, from which a map updates the weights
    living_mm: float = 0.4  # own motion of living tissue, half of 0.8 mm peak to peak (Faria 2014)
    quiet: float = 0.2  # least share of the frames, or of a breath, that shows the tissue's own motion
    unlikely: float = 1e-6  # least weight of an assumption that the interval is to hold
    breath_hz: float = 0.2  # slowest breath; a shorter span without motion may be where it turns
    steeper: float = 1.2  # slope relative to the last, from which a frame may be solved by its own mechanics
    solved: int = 4  # frames so solved, at most
    linear: float = 14.4  # largest force over E [mm^2] in the linear range: P = 0.4 of a contact of 6 mm
    unsolved: tuple[float, float] = (0.8, 2.0)
    """Gains of the linear force that hold what it may be where motion is large and not solved: those of nine
    driven contacts of 75 to 260 mN were 0.93 to 1.6."""
    gain: float = 0.25  # relative deviation of force from relief, pose and the law at large strain


TISSUES = TissueConstants()


@dataclass(frozen=True)
class TissueWeights:
    """The most likely tissues of a video, given its frames so far."""

    tissues: tuple[TissueKind, ...]
    weight: Floats  # of each tissue, with sum 1
    own_mm: Floats  # (C, 6, M) modes of the tissue's own motion, see `own_motion`
    assumed: bool  # whether that is a bound on what is not known, so that it may be 0

    @property
    def middle(self) -> TissueKind:
        """The tissue to solve large motion on: the likeliest, with the geometric mean stiffness of those of
        its edge and stretch, as the likeliest stiffness is hardly likelier than others."""
        first = self.tissues[0]
        if first.membrane == 0:
            return first
        indices = [
            k
            for k, tissue in enumerate(self.tissues)
            if (tissue.edge, tissue.stretch) == (first.edge, first.stretch) and tissue.membrane > 0
        ]
        logs = np.log([self.tissues[k].membrane for k in indices])
        return replace(first, membrane=float(f"{np.exp(np.average(logs, weights=self.weight[indices])):.3g}"))


@dataclass(frozen=True)
class Gains:
    """Factors of the linear force where motion is large, by that force: at both ends of what is not known."""

    size: Floats  # (K,) mN/kPa, rising
    low: Floats  # (K,)
    high: Floats  # (K,)
    unsolved: int = 0  # states whose mechanics found no solution, or with one camera

    def interpolate(self, size: float) -> tuple[float, float]:
        return float(np.interp(size, self.size, self.low)), float(np.interp(size, self.size, self.high))


NO_GAIN = Gains(np.zeros(1), np.ones(1), np.ones(1))


class Physics:
    """A `Revising` method, see the module; without a force map its estimates are NaN until `revise`."""

    share_left: Floats
    """(T,) after `revise`: the part of each frame's elastic force that relaxation leaves; 1 without."""

    def __init__(self) -> None:
        self._scene: MethodContext | None = None

    def _begin(self, scene: MethodContext, components: int) -> None:
        """Starts a video whose displacement has 2 or 3 components."""
        self._scene, self._view = scene, GridView(scene.tissue, scene.scale_mm_per_px, GRID)
        tissues = candidate_tissues(scene)
        self._is_edge_seen = is_edge_seen(scene)
        # On tissue wider than an opening a contact may be farther from the middle than loads are sought.
        self._wide_view: GridView | None = None
        if {tissue.edge for tissue in tissues} == {"free"}:
            grid = load_window.cover_tissue(scene.tissue, self._view.centre_px, scene.scale_mm_per_px)
            self._wide_view = GridView(scene.tissue, scene.scale_mm_per_px, grid)
        self._middle: load_window.Point = (0.0, 0.0)
        self._strongest_mm = 0.0  # largest motion of a place
        self._missed = list[
            tuple[float, float]
        ]()  # places out of the window: motion, distance from its middle
        self._views: dict[Offset, GridView] = {(0, 0): self._view}
        self._offsets: list[Offset] = []
        self._frames: list[Observation] = []
        self._contact_free, self._weighed_mm = 0, 0.0  # frames; motion at the last weighting
        first, no_motion = tissues[:1], np.zeros((components, 6, 0))
        self._times, self._trusted = list[float](), list[bool]()
        self._large, self._gains = list[tuple[Observation, SeenMotion]](), NO_GAIN
        self._weights = TissueWeights(first, np.ones(1), no_motion, False)

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`; of elastic tissue, until `revise`."""
        if frame.motion is None:
            scale = np.float32(scene.scale_mm_per_px)
            moved = frame.flow * scale
            spread = np.repeat(scale * deviation(frame.confidence)[..., None], 2, axis=2)
        else:
            moved, spread = frame.motion.motion, frame.motion.deviation
        if self._scene is not scene:
            self._begin(scene, moved.shape[2])
        fields = moved.transpose(2, 0, 1), spread.transpose(2, 0, 1)
        if frame.trusted and self._wide_view is not None:
            self._place_window(self._wide_view, *fields)
        offset = self._find_offset()
        view = self._views[offset]
        moved, spread = (view.mean(field) for field in fields)
        observation = observe(moved, spread, view.mask)
        self._frames.append(observation)
        self._offsets.append(offset)
        self._times.append(frame.time_s or 0.0)
        self._trusted.append(frame.trusted)
        if frame.trusted:
            if self._is_edge_seen and view is not self._view:  # an opening is about the tissue's middle
                view = self._view
                moved, spread = (view.mean(field) for field in fields)
            surface = large_motion.measure_motion(moved, spread, view.mask, GRID)
            least_slope = self._large[-1][1].slope * TISSUES.steeper if self._large else 0.0
            if surface.slope > max(large_motion.STEEP, least_slope):
                self._large.append((observation, surface))
        if not picture:
            return ForceEstimate(np.full(3, np.nan))
        if observation.signal_mm > max(TISSUES.growth * self._weighed_mm, posterior.MODEL.least_mm):
            self._weighed_mm = observation.signal_mm
            self._weights = weigh_tissues(scene, self._frames[-1:], self._weights.own_mm)
        return self._conclude(*self._infer(observation), picture=picture)

    def _place_window(self, view: GridView, moved: Field, spread: Field) -> None:
        """Moves the window in which loads are sought to the places that move."""
        assert self._scene is not None
        own_mm = TISSUES.living_mm if self._scene.living else 0.0
        on_grid = view.mean(moved), view.mean(spread), view.mask
        places = load_window.find_places(*on_grid, view.grid, _MOVING_MM + own_mm)
        self._middle, missed = load_window.place_window(places, self._middle)
        self._strongest_mm = max(self._strongest_mm, *(place.motion_mm for place in places), 0.0)
        self._missed += [
            (place.motion_mm, load_window.measure_distance(place.point, self._middle)) for place in missed
        ]

    def _find_offset(self) -> Offset:
        """The window's middle in whole nodes, with its view."""
        view, step = self._view, compliance.NODE_MM
        x, y = (round(value / step) for value in self._middle)
        if (x, y) not in self._views:
            step_px = step / view.scale_mm_per_px
            centre_px = view.centre_px[0] + x * step_px, view.centre_px[1] + y * step_px
            self._views[x, y] = GridView(view.tissue, view.scale_mm_per_px, GRID, centre_px)
        return x, y

    def revise(self, contact_free: Mask) -> list[ForceEstimate]:
        """See `Revising`."""
        assert self._scene is not None
        basis = posterior.load_basis(len(self._frames[0].moved), candidate_tissues(self._scene)[0])
        times, tracked = np.array(self._times), np.flatnonzero(self._trusted)
        free_frames = [self._frames[k] for k in np.flatnonzero(contact_free) if self._frames[k].size_mm > 0]
        breaths = TISSUES.breath_hz * float(np.diff(times)[contact_free[1:] & contact_free[:-1]].sum())
        if is_bounded := self._scene.living and len(tracked) > 0 and breaths < 0.5:
            frames = [self._frames[k] for k in tracked]
            quiet, factor = quietest_frames(times[tracked], frames)
            bounds = [factor * posterior.own_motion(basis, [frames[k] for k in quiet], correlated=False)]
            if breaths > TISSUES.quiet:
                bounds.append(
                    turning_factor(breaths) * posterior.own_motion(basis, free_frames, correlated=False)
                )
            least_bound = min(bounds, key=lambda bound: float(np.square(bound).sum()))
            own_mm = least_bound.clip(-TISSUES.living_mm, TISSUES.living_mm)
        else:
            own_mm = posterior.own_motion(basis, free_frames)
        self._weights = weigh_tissues(self._scene, self._frames, own_mm, is_bounded and bool(own_mm.any()))
        strongest = max(self._frames, key=lambda frame: frame.signal_mm)
        if len(strongest.moved) == 2:
            self._gains = find_monocular_gains(self._weights, strongest, bool(self._large))
        else:
            self._gains = find_gains(self._scene, self._weights, self._large)
        self._contact_free = int(contact_free.sum())
        posteriors = [self._infer(frame) for frame in self._frames]
        estimates = [self._conclude(*answer, picture=False) for answer in posteriors]
        loads = np.stack([answer.load.astype(np.float32) for answer, *_ in posteriors])
        joined, trusted = join_loads(loads, self._offsets), np.array(self._trusted)
        self.share_left = relaxation.measure_share_left(joined, times, trusted, self._scene.relaxation)
        self._loads = list(loads * self.share_left.astype(np.float32)[:, None, None])
        relaxed = [
            estimate.scale_by(share) for estimate, share in zip(estimates, self.share_left, strict=True)
        ]
        return widen_small_forces(relaxed)

    @property
    def view(self) -> GridView:
        """`GRID` on the last video's pictures."""
        return self._view

    def map_forces(self) -> Map:
        """(T, N, N) magnitude of the force density in `GRID`'s cells [kPa], of the last `revise`."""
        assert self._scene is not None
        young = self._scene.young_kpa or UNKNOWN_YOUNG_KPA
        maps = []
        for load, offset in zip(self._loads, self._offsets, strict=True):
            lattice, step = self._lattice(load)
            x, y = ((GRID.size - 1) / 2 + number * step / GRID.pitch_mm for number in offset)
            maps.append(to_image(young * lattice, (GRID.size,) * 2, (x, y), GRID.pitch_mm, step))
        return np.stack(maps)

    @property
    def notes(self) -> list[str]:
        """What the video shows about the tissue."""
        if self._scene is None:
            return []
        basis = posterior.load_basis(len(self._weights.own_mm), self._weights.tissues[0])
        moved = posterior.polynomials(basis.lattice.points) @ self._weights.own_mm  # (C, P, M)
        sizes = ", ".join(f"{np.sqrt(square.sum(axis=1).mean()):.2g}" for square in np.square(moved))
        statement = f"the tissue's own motion is {sizes} mm along {', '.join('xyz'[: len(moved)])}"
        if self._weights.assumed or not self._contact_free:
            shortfall = "only part of a breath" if self._contact_free else "no span"
            statement = f"{'at most, ' * self._weights.assumed}{statement}"
            lack = f"{shortfall} without contact is known in video time (sensor.free_s, pulse.free_s)"
            statement = f"{lack}: {statement}"
        lines = [describe(self._weights, self._scene), statement]
        if self._scene.relaxation:
            lines.append(f"relaxation, as stated, leaves {self.share_left.min():.0%} of a force or more")
        return lines

    @property
    def warnings(self) -> list[str]:
        """What its result must not be taken for."""
        if self._scene is None:
            return []
        least_mm = load_window.RULE.named * self._strongest_mm
        if far_mm := [distance_mm for motion_mm, distance_mm in self._missed if motion_mm >= least_mm]:
            fault = f"tissue moves {max(far_mm):.0f} mm from where loads are sought, too"
            return [f"{fault}: a part of the force may be missing", *self._large_warnings]
        return self._large_warnings

    @property
    def _large_warnings(self) -> list[str]:
        if not self._gains.unsolved:
            return []
        fault = "the surface is bent beyond the range of the linear inverse"
        if self._is_beyond:
            return [f"{fault}, with one camera and perhaps a membrane: forces may be many times larger"]
        reason = "with one camera" if len(self._weights.own_mm) == 2 else "and no equilibrium is found"
        return [f"{fault}, {reason}: its largest forces are out of range, their intervals wide"]

    @property
    def _is_beyond(self) -> bool:
        """Whether the error isn't bounded: with one camera forces of large motion were 3 to 100 times the
        estimate where there is a membrane or may be one."""
        may_be_covered = self._scene is not None and self._scene.membrane != "stripped"
        return self._gains.unsolved > 0 and len(self._weights.own_mm) == 2 and may_be_covered

    def _conclude(self, answer: Posterior, low_gain: float, high_gain: float, picture: bool) -> ForceEstimate:
        """The estimate of `_infer`'s answer."""
        assert self._scene is not None
        young = self._scene.young_kpa or UNKNOWN_YOUNG_KPA
        factor, cameras = float(np.sqrt(low_gain * high_gain)), len(self._weights.own_mm) - 1
        gain = float(np.hypot(TISSUES.gain, self._scene.young_uncertainty))
        low, high = size_interval(answer.force, gain, cameras)
        low, high = (
            (np.nan, np.nan) if self._is_beyond else (low * low_gain / factor, high * high_gain / factor)
        )
        density = np.float32(young) * self._picture(answer.load) if picture else None
        mixture = answer.force.scale_by(young).with_gain(
            float(np.hypot(TISSUES.gain, 0.3 * np.log(high_gain / low_gain)))
        )
        size = young * answer.force.find_size(cameras)
        return ForceEstimate(young * answer.force.mean, density, young * low, young * high, mixture, size)

    def _infer(self, frame: Observation) -> tuple[Posterior, float, float]:
        """The posterior with the gain of large motion, and the ends of that gain."""
        linear = infer(self._weights, frame)
        low_gain, high_gain = self._gains.interpolate(float(np.linalg.norm(linear.force.mean)))
        factor = float(np.sqrt(low_gain * high_gain))
        answer = replace(linear, force=linear.force.scale_by(factor), load=factor * linear.load)
        return answer, low_gain, high_gain

    def _picture(self, load: Floats) -> Field:
        """The force density over E, (H, W), on the rest frame's pixels, of the last frame."""
        (lattice, step), view = self._lattice(load), self._views[self._offsets[-1]]
        return to_image(lattice, view.shape, view.centre_px, view.scale_mm_per_px, step)

    def _lattice(self, load: Map | Floats) -> tuple[Floats, float]:
        """The force density over E at the nodes of a square lattice about the middle one, and their
        distance [mm]."""
        grid, (column, row) = compliance.lattice(), number_nodes().T
        half = max(column.max(), row.max())
        lattice = np.zeros((2 * half + 1,) * 2)
        lattice[row + half, column + half] = np.linalg.norm(load, axis=1) / grid.node_area
        return lattice, compliance.NODE_MM


def number_nodes() -> Ints:
    """Column and row (K, 2) of the nodes that bear loads, from the middle one."""
    return np.rint(compliance.lattice().nodes / compliance.NODE_MM).astype(int)


def join_loads(loads: Map, offsets: Sequence[Offset]) -> Map:
    """Loads (T, K, 3) at the nodes about each frame's offset as (T, 3 N) at nodes that all frames share."""
    nodes = number_nodes()
    places = (nodes[None] + np.array(offsets)[:, None]).reshape(-1, 2)
    shared, index = np.unique(places, axis=0, return_inverse=True)
    joined = np.zeros((len(loads), len(shared), 3), np.float32)
    joined[np.repeat(np.arange(len(loads)), len(nodes)), index.ravel()] = loads.reshape(-1, 3)
    return joined.reshape(len(loads), -1)


def quietest_frames(time_s: Floats, frames: Sequence[Observation]) -> tuple[list[int], float]:
    """The frames in which the tissue moves least, and the factor from its motion there to that at any time.

    A large share of frames without motion excludes slow and fast pulsation, a short span only fast one.
    """
    size = np.array([frame.signal_mm**2 for frame in frames])
    order = np.argsort(size, kind="stable")
    count = np.arange(1, len(frames) + 1)
    share = count / len(frames) * min(float(np.ptp(time_s)) * TISSUES.breath_hz, 1.0)
    factor = turning_factor(share)
    bounds_mm = factor * np.sqrt(size[order] + posterior.MODEL.least_mm**2)
    bounds_mm[share < TISSUES.quiet * share[-1]] = np.inf  # the least of many would be too little
    best = int(bounds_mm.argmin())
    return [int(k) for k in order[best // 2 : best + 1]], float(factor[best])


def turning_factor(share: Floats | float) -> Floats:
    """1 / (1 - cos pi q): motion a (1 - cos 2 pi f t) is below a (1 - cos pi q) in a share q of a period."""
    return np.asarray(1 / np.maximum(1 - np.cos(np.pi * np.minimum(share, 0.5)), 1e-6))


def is_edge_seen(scene: MethodContext) -> bool:
    """Whether the tissue's outline is its own, not the picture's border."""
    return measure_border_share(scene.tissue) <= TISSUES.cut


def candidate_tissues(scene: MethodContext) -> tuple[TissueKind, ...]:
    """The tissues that agree with meta.yaml, each with the most likely Poisson's ratio in its range."""
    radius = np.sqrt(scene.tissue.sum() / np.pi) * scene.scale_mm_per_px
    low, high = scene.poisson
    middle = next((nu for nu in TISSUES.poisson if low <= nu <= high), round((low + high) / 2, 3))
    bare, *stiffnesses = TISSUES.membranes_mm
    if scene.membrane_mn_per_mm is not None:
        ends = np.array(scene.membrane_mn_per_mm) / (scene.young_kpa or UNKNOWN_YOUNG_KPA)
        between = np.geomspace(ends[0], ends[1], TISSUES.shown)
        stiffnesses = sorted({float(f"{stiffness:.2g}") for stiffness in between})
    membranes = {"stripped": [bare], "intact": stiffnesses, "unknown": [bare, *stiffnesses]}[scene.membrane]
    edges: tuple[Edge, ...] = ("free",) if radius > TISSUES.wide * OPENING_MM else ("bonded", "slipping")
    if "free" not in edges and not is_edge_seen(scene):
        edges = *edges, "free"  # the tissue's edge may be anywhere beyond the picture
    return tuple(
        TissueKind(edge, membrane, middle, stretch)
        for edge in edges
        for membrane in membranes
        for stretch in (TISSUES.stretches if membrane else TISSUES.stretches[:1])
    )


def _prior(tissues: Sequence[TissueKind], scene: MethodContext) -> Floats:
    """Logarithm of each tissue's prior probability: log-normal in the stiffness of a membrane that is stated
    to be intact, unless its stiffness is too."""
    stiffness = np.array([tissue.membrane for tissue in tissues])
    is_usual = scene.membrane == "intact" and scene.membrane_mn_per_mm is None
    is_covered, spread = stiffness > 0, TISSUES.stiffer if is_usual else np.inf
    log_stiffness = np.log(np.where(is_covered, stiffness, 1.0) * (scene.young_kpa or UNKNOWN_YOUNG_KPA))
    density = -0.5 * np.square((log_stiffness - np.log(TISSUES.stiff_mn_per_mm)) / spread)
    share = {"intact": 1.0, "stripped": 0.0, "unknown": TISSUES.intact}[scene.membrane]
    log_prior = np.full(len(tissues), -np.inf)
    for part, weight in ((is_covered, share), (~is_covered, 1 - share)):
        if part.any() and weight > 0:
            log_prior[part] = np.log(weight) + log_softmax(density[part])
    return log_prior


def weigh_tissues(
    scene: MethodContext, frames: Sequence[Observation], own_mm: Floats, assumed: bool = False
) -> TissueWeights:
    """Weighs tissues by the frames with the largest motion, then Poisson's ratios of the most likely one."""
    strongest = sorted(frames, key=lambda frame: -frame.signal_mm)[: 3 * TISSUES.strongest : 3]
    strongest = [frame for frame in strongest if frame.size_mm > 0]
    evidences: dict[TissueKind, float] = {}  # evidence of those that are computed

    def evidence(tissue: TissueKind, load: Callable[..., LoadBasis] = posterior.load_basis) -> float:
        if tissue not in evidences:
            basis = load(len(own_mm), tissue)
            evidences[tissue] = TISSUES.temper * sum(
                posterior.evidence(basis, frame, own_mm) for frame in strongest
            )
        return evidences[tissue]

    candidates = candidate_tissues(scene)
    logs = dict(zip(candidates, _prior(candidates, scene), strict=True))
    score = dict[TissueKind, float]()
    for part in (False, True):
        if group := [tissue for tissue in candidates if (tissue.membrane > 0) is part]:
            best = find_largest(group, lambda tissue: evidence(tissue) + logs[tissue])
            # Where it isn't known whether there is a membrane, the best with and without one are compared by
            # their evidence: spread over stiffnesses, it would count for bare tissue too.
            variants = [tissue for tissue in group if replace(tissue, membrane=best.membrane) == best]
            variants = variants if scene.membrane == "intact" else [best]
            score |= _share(
                variants, [evidence(tissue) for tissue in variants], [logs[tissue] for tissue in variants]
            )
    best = max(score, key=lambda tissue: score[tissue])
    low, high = scene.poisson
    others = [nu for nu in TISSUES.poisson if low <= nu <= high and nu != best.poisson]
    score[best] -= np.log(1 + len(others))  # the ratios share its prior probability
    for nu in others:
        tissue = replace(best, poisson=nu)
        delta = evidence(tissue, posterior.load_basis_alone) - evidence(best)
        # As evidence between stiffnesses: a ratio that fits must not bring its one stiffness alone.
        delta = TISSUES.doubt * np.tanh(delta / TISSUES.doubt) if scene.membrane == "intact" else delta
        score[tissue] = score[best] + delta
    weight = np.maximum(softmax(list(score.values())), TISSUES.unlikely)
    order = np.argsort(-weight, kind="stable")
    tissues = list(score)
    return TissueWeights(tuple(tissues[k] for k in order), weight[order] / weight.sum(), own_mm, assumed)


def _share(
    tissues: Sequence[TissueKind], evidence: Sequence[float], logs: Sequence[float]
) -> dict[TissueKind, float]:
    """Log weights of the likeliest of tissues that differ in stiffness alone, with differences of evidence of
    at most `TISSUES.doubt`; `logs`: of their prior probabilities."""
    behind = np.subtract(evidence, max(evidence))
    weight = max(evidence) + TISSUES.doubt * np.expm1(behind / TISSUES.doubt) + np.array(logs)
    return {tissues[k]: float(weight[k]) for k in np.argsort(-weight, kind="stable")[: TISSUES.shown]}


def find_largest(candidates: Sequence[TissueKind], value: Callable[[TissueKind], float]) -> TissueKind:
    """The candidate of the largest value, by a search uphill that looks at half of them.

    Along the membrane's stiffness evidence has one maximum, which is another one for each edge.
    """
    stiffness = sorted({tissue.membrane for tissue in candidates})

    def climb(tissue: TissueKind) -> TissueKind:
        for step in (-1, 1):
            index = stiffness.index(tissue.membrane) + step
            while 0 <= index < len(stiffness):
                neighbour = replace(tissue, membrane=stiffness[index])
                if value(neighbour) <= value(tissue):
                    break
                tissue, index = neighbour, index + step
        return tissue

    middle = stiffness[len(stiffness) // 2]
    previous, best = None, climb(next(tissue for tissue in candidates if tissue.membrane == middle))
    while best != previous:
        previous = best
        edges = [tissue for tissue in candidates if replace(tissue, edge=best.edge) == best]
        best = max((best, *map(climb, edges)), key=value)
        stretches = [tissue for tissue in candidates if replace(tissue, stretch=best.stretch) == best]
        best = climb(max((best, *stretches), key=value))
    return best


def infer(weights: TissueWeights, frame: Observation) -> Posterior:
    """The posterior of a frame's loads, as a mixture over tissues."""
    components, weight = len(weights.own_mm), weights.weight
    worlds = [(tissue, weights.own_mm) for tissue in weights.tissues]
    if weights.assumed:
        worlds.append((weights.tissues[0], weights.own_mm[..., :0]))
        weight = np.append(weight, TISSUES.unlikely)
    posteriors = [
        posterior.infer(posterior.load_basis(components, tissue), frame, modes) for tissue, modes in worlds
    ]
    return Posterior(
        float(weight @ [answer.evidence for answer in posteriors]),
        mix([answer.force for answer in posteriors], weight, range(len(posteriors))),
        sum((share * answer.load for share, answer in zip(weight, posteriors, strict=True)), np.zeros(())),
    )


def find_gains(
    scene: MethodContext, weights: TissueWeights, large: Sequence[tuple[Observation, SeenMotion]]
) -> Gains:
    """Gains of frames with large motion, of rising slope, on the middle tissue; few of them are solved."""
    tissue, radius = weights.middle, np.sqrt(scene.tissue.sum() / np.pi) * scene.scale_mm_per_px
    opening_mm = min(float(radius), large_motion.OPEN_MM) if is_edge_seen(scene) else None
    rows, unsolved = [(0.0, 1.0, 1.0)], 0
    for frame, motion in large[::-2][: TISSUES.solved]:
        size = float(np.linalg.norm(infer(weights, frame).force.mean))
        if size == 0:
            continue
        ends = TISSUES.unsolved
        try:
            forces = [
                large_motion.reaction(motion, tissue, opening_mm, alpha) for alpha in sorted(set(scene.alpha))
            ]
            sizes = [float(np.linalg.norm(force)) / size for force in forces]
            ends = min(sizes), max(sizes)
        except ExcessiveLoad:
            unsolved += 1
        rows.append((size, *ends))
    size_mn, low, high = np.array(sorted(rows)).T
    return Gains(size_mn, low, high, unsolved)


def find_monocular_gains(weights: TissueWeights, strongest: Observation, is_steep: bool) -> Gains:
    """Gains with one camera, to which depth is hidden: what they may be where the linear force is large, or
    motion across the view steep."""
    size = float(np.linalg.norm(infer(weights, strongest).force.mean))
    if size <= TISSUES.linear and not is_steep:
        return NO_GAIN
    low, high = TISSUES.unsolved
    linear = TISSUES.linear if size > TISSUES.linear else 0.5 * size
    return Gains(np.array([0.0, linear, size]), np.array([1, 1, low]), np.array([1, 1, high]), 1)


@lru_cache(maxsize=1)
def _places() -> Floats:
    points = compliance.lattice().points
    return np.asarray(points.T[::-1] / GRID.pitch_mm + (GRID.size - 1) / 2, np.float64)


def observe(moved: Field, spread: Field, mask: Field) -> Observation:
    """Samples displacement and its deviation, (C, N, N) mm on `GRID`, at the compliance's points; outside the
    tissue's mask (N, N) the deviation is infinite."""
    places = _places()
    inside = map_coordinates(mask, places, order=1, mode="constant") > 0.5
    values = [
        np.stack([map_coordinates(part, places, order=1, mode="nearest") for part in parts]).astype(
            np.float64
        )
        for parts in (moved, spread)
    ]
    return Observation(np.where(inside, values[0], 0.0), np.where(inside, values[1], np.inf))


def describe(weights: TissueWeights, scene: MethodContext) -> str:
    """The most likely tissue, in words."""
    edge, nu = weights.tissues[0].edge, weights.tissues[0].poisson
    rest = f"tissue edge {edge}, Poisson's ratio {nu:g}"
    if scene.membrane != "unknown":
        return f"membrane {scene.membrane}, as stated; {rest}"
    unit = "mm times E" if scene.young_kpa is None else "mN/mm"
    stiff = weights.tissues[0].membrane * (scene.young_kpa or UNKNOWN_YOUNG_KPA)
    likeliest = f"likeliest is one of {stiff:.2g} {unit}" if stiff else "likeliest is none"
    advice = ", a living brain's is intact unless it was opened" if scene.living else ""
    verdict = f"motion does not reliably show whether there is a membrane (meta.yaml's `membrane`{advice})"
    return f"{verdict}: intervals hold both, {likeliest}; {rest}"
