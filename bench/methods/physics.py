"""Physics as a method: `posterior` on every frame, with tissue parameters weighted by the whole video.

At its end spans without contact give the tissue's own motion, the frames with the largest motion its edge,
membrane and Poisson's ratio; a force map requested earlier uses the frame with the largest motion so far.
Where the surface is bent beyond the linear range, some frames are then solved by `large_motion`; those
between them take the gain over the linear force that these show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

from bench.methods import compliance, large_motion, posterior, relaxation
from bench.methods.force_mixture import size_interval
from bench.methods.large_motion import SeenMotion
from bench.methods.load_window import LoadWindow, Offset, index_nodes, join_loads
from bench.methods.method_interface import (
    Field,
    ForceEstimate,
    FrameMotion,
    MethodContext,
    widen_small_forces,
)
from bench.methods.posterior import Observation, Posterior
from bench.methods.tissue_weights import (
    TissueWeights,
    candidate_tissues,
    describe,
    infer,
    is_edge_seen,
    weigh_tissues,
)
from learn.data.clips import UNKNOWN_YOUNG_KPA
from learn.data.grid import Grid, GridView, to_image
from synth.arrays import Floats, Map, Mask
from synth.fem.equilibrium import ExcessiveLoad
from synth.flow.confidence import deviation

GRID = Grid(48)


@dataclass(frozen=True)
class PhysicsConstants:
    """Constants of a video's estimates; by hand where no source is given."""

    growth: float = 1.3  # motion relative to the last weighting's, from which a map updates the weights
    living_mm: float = 0.4  # own motion of living tissue, half of 0.8 mm peak to peak (Faria 2014)
    quiet: float = 0.2  # least share of the frames, or of a breath, that shows the tissue's own motion
    breath_hz: float = 0.2  # slowest breath; a shorter span without motion may be where it turns
    steeper: float = 1.2  # slope relative to the last, from which a frame may be solved by its own mechanics
    solved: int = 4  # frames so solved, at most
    linear: float = 14.4  # largest force over E [mm^2] in the linear range: P = 0.4 of a contact of 6 mm
    most_gain: float = 4.0
    most_ratio: float = 1.8
    """Gain, and ratio of the gains of both ends, beyond which the motion is taken for wrong: in 51 sequences
    of `mission-ood` and `clinical` of right motion they were up to 3.8 and 1.6, in two of wrong motion 4.4 to
    7.4 and 1.8 to 2.8."""
    unsolved: tuple[float, float] = (0.8, 2.0)
    """Gains of the linear force that hold what it may be where motion is large and not solved: those of nine
    driven contacts of 75 to 260 mN were 0.93 to 1.6."""
    own_amplitude: float = 0.8
    """Largest amplitude of the tissue's own motion that is taken off large motion, in deviations of modes:
    the peak of a sinusoid from rest is 1.6 of its root mean square, which `MODEL.unmet` doubles. The linear
    inverse finds more, as its own motion takes up what loads don't explain."""
    gain: float = 0.25  # relative deviation of force from relief, pose and the law at large strain


PHYSICS = PhysicsConstants()


@dataclass(frozen=True, eq=False)
class LargeFrame:
    """A frame whose motion leaves the linear range."""

    observation: Observation  # about the middle of the loads
    motion: SeenMotion
    middle_mm: Floats  # (2,) of the loads from the middle of the motion's grid, camera x and y


@dataclass(frozen=True)
class Gains:
    """Factors of the linear force where motion is large, by that force: at both ends of what is not known."""

    size: Floats  # (K,) mN/kPa, rising
    low: Floats  # (K,)
    high: Floats  # (K,)
    unsolved: int = 0  # states without a plausible equilibrium, or with one camera

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
        own_mm = PHYSICS.living_mm if scene.living else 0.0
        # On tissue wider than an opening a contact may be farther from the middle than loads are sought.
        is_wide = {tissue.edge for tissue in tissues} == {"free"}
        self._window = LoadWindow(self._view, own_mm, is_wide)
        self._is_edge_seen = is_edge_seen(scene)
        self._frames, self._offsets = list[Observation](), list[Offset]()
        self._contact_free, self._weighed_mm = 0, 0.0  # frames; motion at the last weighting
        first, no_motion = tissues[:1], np.zeros((components, 6, 0))
        self._times, self._trusted = list[float](), list[bool]()
        self._large, self._gains = list[LargeFrame](), NO_GAIN
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
        if frame.trusted:
            self._window.follow(*fields)
        self._offsets.append(self._window.offset)
        view = self._window.view
        moved, spread = (view.mean(field) for field in fields)
        observation = observe(moved, spread, view.mask)
        self._frames.append(observation)
        self._times.append(frame.time_s or 0.0)
        self._trusted.append(frame.trusted)
        if frame.trusted:
            middle_mm = np.zeros(2)
            if self._is_edge_seen and view is not self._view:  # an opening is about the tissue's middle
                view, middle_mm = self._view, np.array(self._window.find_middle())
                moved, spread = (view.mean(field) for field in fields)
            surface = large_motion.measure_motion(moved, spread, view.mask, GRID, middle_mm)
            least_slope = self._large[-1].motion.slope * PHYSICS.steeper if self._large else 0.0
            if surface.slope > max(large_motion.STEEP[len(moved)], least_slope):
                self._large.append(LargeFrame(observation, surface, middle_mm))
        if not picture:
            return ForceEstimate(np.full(3, np.nan))
        if observation.signal_mm > max(PHYSICS.growth * self._weighed_mm, posterior.MODEL.least_mm):
            self._weighed_mm = observation.signal_mm
            self._weights = weigh_tissues(scene, self._frames[-1:], self._weights.own_mm)
        return self._conclude(*self._infer(observation), picture=picture)

    def revise(self, contact_free: Mask) -> list[ForceEstimate]:
        """See `Revising`."""
        assert self._scene is not None
        basis = posterior.load_basis(len(self._frames[0].moved), candidate_tissues(self._scene)[0])
        times, tracked = np.array(self._times), np.flatnonzero(self._trusted)
        free_frames = [self._frames[k] for k in np.flatnonzero(contact_free) if self._frames[k].size_mm > 0]
        breaths = PHYSICS.breath_hz * float(np.diff(times)[contact_free[1:] & contact_free[:-1]].sum())
        if is_bounded := self._scene.living and len(tracked) > 0 and breaths < 0.5:
            frames = [self._frames[k] for k in tracked]
            quiet, factor = quietest_frames(times[tracked], frames)
            bounds = [factor * posterior.own_motion(basis, [frames[k] for k in quiet], correlated=False)]
            if breaths > PHYSICS.quiet:
                bounds.append(
                    turning_factor(breaths) * posterior.own_motion(basis, free_frames, correlated=False)
                )
            least_bound = min(bounds, key=lambda bound: float(np.square(bound).sum()))
            own_mm = least_bound.clip(-PHYSICS.living_mm, PHYSICS.living_mm)
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
        self.share_left = np.ones(len(loads))
        if terms := self._scene.relaxation:
            joined, trusted = join_loads(loads, self._offsets), np.array(self._trusted)
            self.share_left = relaxation.measure_share_left(joined, times, trusted, terms)
        self._loads = list(loads * self.share_left.astype(np.float32)[:, None, None])
        relaxed = [
            estimate.scale_by(share) for estimate, share in zip(estimates, self.share_left, strict=True)
        ]
        return widen_small_forces(relaxed)

    @property
    def view(self) -> GridView:
        """`GRID` on the last video's pictures, about the last frame's loads."""
        return self._window.view

    @property
    def centres_px(self) -> Floats:
        """(T, 2) x, y of the middle of each frame's loads and force map, px."""
        return np.array([self._window.locate(offset) for offset in self._offsets])

    def map_forces(self) -> Map:
        """(T, N, N) magnitude of the force density [kPa], of the last `revise`, in `GRID`'s cells about each
        frame's `centres_px`."""
        assert self._scene is not None
        young, middle = self._scene.young_kpa or UNKNOWN_YOUNG_KPA, ((GRID.size - 1) / 2,) * 2
        maps = []
        for load in self._loads:
            lattice, step = self._lattice(load)
            maps.append(to_image(young * lattice, (GRID.size,) * 2, middle, GRID.pitch_mm, step))
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
        return [*self._window.warnings, *self._large_warnings]

    @property
    def _large_warnings(self) -> list[str]:
        if not self._gains.unsolved:
            return []
        fault = "the surface is bent beyond the range of the linear inverse"
        if self._is_beyond:
            return [f"{fault}, with one camera and perhaps a membrane: forces may be many times larger"]
        reason = (
            "with one camera" if len(self._weights.own_mm) == 2 else "and no plausible equilibrium is found"
        )
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
        gain = float(np.hypot(PHYSICS.gain, self._scene.young_uncertainty))
        low, high = size_interval(answer.force, gain, cameras)
        low, high = (
            (np.nan, np.nan) if self._is_beyond else (low * low_gain / factor, high * high_gain / factor)
        )
        density = np.float32(young) * self._picture(answer.load) if picture else None
        mixture = answer.force.scale_by(young).with_gain(
            float(np.hypot(PHYSICS.gain, 0.3 * np.log(high_gain / low_gain)))
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
        (lattice, step), view = self._lattice(load), self._window.view
        return to_image(lattice, view.shape, view.centre_px, view.scale_mm_per_px, step)

    def _lattice(self, load: Map | Floats) -> tuple[Floats, float]:
        """The force density over E at the nodes of a square lattice about the middle one, and their
        distance [mm]."""
        grid, (column, row) = compliance.lattice(), index_nodes().T
        half = max(column.max(), row.max())
        lattice = np.zeros((2 * half + 1,) * 2)
        lattice[row + half, column + half] = np.linalg.norm(load, axis=1) / grid.node_area
        return lattice, compliance.NODE_MM


def quietest_frames(time_s: Floats, frames: Sequence[Observation]) -> tuple[list[int], float]:
    """The frames in which the tissue moves least, and the factor from its motion there to that at any time.

    A large share of frames without motion excludes slow and fast pulsation, a short span only fast one.
    """
    size = np.array([frame.signal_mm**2 for frame in frames])
    order = np.argsort(size, kind="stable")
    count = np.arange(1, len(frames) + 1)
    share = count / len(frames) * min(float(np.ptp(time_s)) * PHYSICS.breath_hz, 1.0)
    factor = turning_factor(share)
    bounds_mm = factor * np.sqrt(size[order] + posterior.MODEL.least_mm**2)
    bounds_mm[share < PHYSICS.quiet * share[-1]] = np.inf  # the least of many would be too little
    best = int(bounds_mm.argmin())
    return [int(k) for k in order[best // 2 : best + 1]], float(factor[best])


def turning_factor(share: Floats | float) -> Floats:
    """1 / (1 - cos pi q): motion a (1 - cos 2 pi f t) is below a (1 - cos pi q) in a share q of a period."""
    return np.asarray(1 / np.maximum(1 - np.cos(np.pi * np.minimum(share, 0.5)), 1e-6))


def find_gains(scene: MethodContext, weights: TissueWeights, large: Sequence[LargeFrame]) -> Gains:
    """Gains of frames with large motion, of rising slope, on the middle tissue; few of them are solved."""
    tissue, radius = weights.middle, np.sqrt(scene.tissue.sum() / np.pi) * scene.scale_mm_per_px
    opening_mm = min(float(radius), large_motion.OPEN_MM) if is_edge_seen(scene) else None
    rows, unsolved = [(0.0, 1.0, 1.0)], 0
    for frame in large[::-2][: PHYSICS.solved]:
        linear = infer(weights, frame.observation)
        size = float(np.linalg.norm(linear.force.mean))
        if size == 0:
            continue
        ends, moved = PHYSICS.unsolved, [take_off_own_motion(frame, weights.own_mm, linear.own_amplitudes)]
        if weights.assumed:  # or the tissue is still, and what the inverse took for its motion is the load's
            moved.append(frame.motion)
        try:
            forces = np.array(
                [
                    [
                        large_motion.reaction(motion, tissue, opening_mm, alpha)
                        for alpha in sorted(set(scene.alpha))
                    ]
                    for motion in moved
                ]
            )
            sizes = np.linalg.norm(forces, axis=2) / size
            sizes[forces @ linear.force.mean <= 0] = np.inf  # the motion is wrong, or of several contacts
        except ExcessiveLoad:
            sizes = np.full((1, 1), np.inf)
        least, most = sizes.min(axis=1), sizes.max(axis=1)
        if (most <= np.minimum(PHYSICS.most_gain, PHYSICS.most_ratio * least)).all():
            ends = float(least.min()), float(most.max())
        else:
            unsolved += 1
        rows.append((size, *ends))
    size_mn, low, high = np.array(sorted(rows)).T
    return Gains(size_mn, low, high, unsolved)


def take_off_own_motion(frame: LargeFrame, own_mm: Floats, amplitudes: Floats) -> SeenMotion:
    """What loads move: no force at the surface causes the tissue's own motion, `own_mm` (C, 6, M) by its
    amplitudes (M,)."""
    coefficients = own_mm @ amplitudes.clip(-PHYSICS.own_amplitude, PHYSICS.own_amplitude)
    moved_mm = posterior.polynomials(frame.motion.points - frame.middle_mm) @ coefficients.T
    return replace(frame.motion, moved=frame.motion.moved - moved_mm)


def find_monocular_gains(weights: TissueWeights, strongest: Observation, is_steep: bool) -> Gains:
    """Gains with one camera, to which depth is hidden: what they may be where the linear force is large, or
    motion across the view steep."""
    size = float(np.linalg.norm(infer(weights, strongest).force.mean))
    if size <= PHYSICS.linear and not is_steep:
        return NO_GAIN
    low, high = PHYSICS.unsolved
    linear = PHYSICS.linear if size > PHYSICS.linear else 0.5 * size
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
