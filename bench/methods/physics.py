"""Physics behind the bench's protocol: `posterior` on every frame, the film saying what tissue it is.

Frames are answered once the film is over: the span without contact has told how the tissue moves by itself,
the strongest frames together its edge, membrane and Poisson's ratio. A picture that is wanted before rests on
what the strongest frame until then said of the tissue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import softmax

from bench.methods import posterior
from bench.methods.baselines import GRID
from bench.methods.compliance import OPENING_MM, Edge, TissueKind
from bench.methods.force_mixture import mix, size_interval
from bench.methods.posterior import Observation, Posterior
from bench.methods.protocol import Field, ForceEstimate, MethodContext, widen_small_forces
from learn.data.clips import assumed_young
from learn.data.grid import GridView
from synth.flow.confidence import deviation
from synth.flow.stereo.track import Moved
from synth.job.types import MembraneState

Floats = NDArray[np.float64]

MEMBRANES = (0.0, 5.0, 15.0, 40.0, 100.0)
"""Stiffness over E [mm]."""
STRETCHES = (1.0, 1.02)
"""Of a membrane at rest: slack, or as a living head's may be."""
_THIN = 5.0
"""Up to here films of bare tissue look alike: the compliance's misfit is as large."""
_INTACT = 0.33
"""How likely a membrane is that nobody speaks of."""
_POISSON = (0.45, 0.4, 0.49)
_WIDE = 1.2
"""Tissue that reaches so many openings' radii is not held by a skull round an opening."""
_TEMPER = 0.1
"""Frames of a film err alike, and alike at neighbouring points: so much of their evidence counts."""
_STRONGEST, _ANEW, _LEAST = 8, 1.3, 0.05
_GAIN, _STIFFNESS = 0.25, 0.5
"""Relative deviation of the force by what no film tells: relief, pose, the law at large strain; and, where
there is a membrane, by its stiffness, which large strains and wrinkles hide."""


@dataclass(frozen=True)
class Film:
    """What is known of a film by now."""

    tissues: tuple[TissueKind, ...]
    weight: Floats
    """Of each tissue; they add up to 1."""
    own_mm: Floats
    """(C,) size of the tissue's own motion."""
    membrane: float
    """How likely there is one that is not thin, of all tissues that were asked about."""


class Physics:
    """See the module; `Revising`, and without a picture NaN until then."""

    def __init__(self) -> None:
        self._scene: MethodContext | None = None

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`."""
        scale = np.float32(scene.scale_mm_per_px)
        spread = np.repeat(scale * deviation(confidence)[..., None], 2, axis=2)
        return self._add(flow * scale, spread, scene, picture)

    def in_space(
        self, flow: Field, confidence: Field, moved: Moved, scene: MethodContext, picture: bool
    ) -> ForceEstimate:
        """See `Uses3D`."""
        return self._add(moved.motion, moved.deviation, scene, picture)

    def revise(self, contact_free: NDArray[np.bool_]) -> list[ForceEstimate]:
        """See `Revising`."""
        assert self._scene is not None
        own = [one for one, free in zip(self._seen, contact_free, strict=True) if free and one.size_mm > 0]
        components = len(self._seen[0].moved)
        basis = posterior.load_basis(components, grid_of(self._scene)[0])
        self._film = weigh_tissues(self._scene, self._seen, posterior.own_motion(basis, own))
        self._contact_free = int(contact_free.sum())
        return widen_small_forces([self._answer(one, False) for one in self._seen])

    @property
    def notes(self) -> list[str]:
        """What the film said of the tissue."""
        if self._scene is None:
            return []
        own = self._film.own_mm
        said = f"the tissue moves by itself by {', '.join(f'{one:.2g}' for one in own)} mm along x, y, z"
        if not self._contact_free:
            said = (
                "no span without contact is known on the film's clock (sensor.free_s, or pulse.free_s where "
                "clocks are found by correlation): what the tissue does by itself is taken for loads"
            )
        return [describe(self._film, self._scene), said]

    def _add(self, moved: Field, spread: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        if self._scene is not scene:
            self._scene, self._view = scene, GridView(scene.tissue, scene.scale_mm_per_px, GRID)
            self._seen: list[Observation] = []
            self._contact_free, self._weighed = 0, 0.0
            self._film = Film(grid_of(scene)[:1], np.ones(1), np.zeros(moved.shape[2]), _INTACT)
        mean = self._view.resample.mean
        moved, spread = (mean(field.transpose(2, 0, 1), scene.tissue) for field in (moved, spread))
        seen = observe(moved, spread, self._view.mask)
        self._seen.append(seen)
        if not picture:
            return ForceEstimate(np.full(3, np.nan))
        if seen.signal_mm > _ANEW * self._weighed and seen.signal_mm > posterior.LEAST_MM:
            self._weighed = seen.signal_mm
            self._film = weigh_tissues(scene, self._seen[-1:], self._film.own_mm)
        return self._answer(seen, picture)

    def _answer(self, seen: Observation, picture: bool) -> ForceEstimate:
        assert self._scene is not None
        young = assumed_young(self._scene.young_kpa)
        found = infer(self._film, seen)
        covered = float(self._film.weight @ [one.membrane > 0 for one in self._film.tissues])
        force = replace(found.force, common=_STIFFNESS * covered)
        gain, eyes = float(np.hypot(_GAIN, self._scene.young_uncertainty)), len(seen.moved) - 1
        low, high = size_interval(force, gain, eyes)
        density = None
        if picture:
            density = np.float32(young) * self._picture(found)
        likely = force.times(young).with_gain(_GAIN)
        return ForceEstimate(young * force.mean, density, young * low, young * high, likely)

    def _picture(self, found: Posterior) -> Field:
        """(H, W) kPa a kPa of E, on the rest frame's pixels."""
        basis = posterior.load_basis(len(self._film.own_mm), self._film.tissues[0])
        known, resample = basis.known, self._view.resample
        step = np.diff(np.unique(known.nodes[:, 0].round(6))).min()
        at = np.rint(known.nodes / step).astype(int)
        lattice = np.zeros((2 * at.max() + 1,) * 2)
        lattice[at[:, 1] + at.max(), at[:, 0] + at.max()] = (
            np.linalg.norm(found.load, axis=1) / known.node_area
        )
        axes = [
            (np.arange(n) - centre) * resample.scale_mm_per_px / step + at.max()
            for n, centre in zip(resample.shape, resample.centre_px[::-1], strict=True)
        ]
        shown = map_coordinates(lattice, np.meshgrid(*axes, indexing="ij"), order=1, mode="constant")
        return np.asarray(shown, np.float32)


def grid_of(scene: MethodContext) -> tuple[TissueKind, ...]:
    """The tissues that a recording may be of, with the likeliest Poisson's ratio of those it allows."""
    radius = np.sqrt(scene.tissue.sum() / np.pi) * scene.scale_mm_per_px
    low, high = scene.poisson
    middle = next((nu for nu in _POISSON if low <= nu <= high), round((low + high) / 2, 3))
    stiff = {"stripped": MEMBRANES[:1], "intact": MEMBRANES[1:], "unknown": MEMBRANES}[scene.membrane]
    edges: tuple[Edge, ...] = ("free",) if radius > _WIDE * OPENING_MM else ("bonded", "slipping")
    return tuple(
        TissueKind(edge, one, middle, stretch)
        for edge in edges
        for one in stiff
        for stretch in (STRETCHES if one else STRETCHES[:1])
    )


def _prior(tissues: Sequence[TissueKind], known: MembraneState) -> Floats:
    assert known in get_args(MembraneState)
    stiff = np.array([one.membrane > 0 for one in tissues])
    if known != "unknown":
        return np.full(len(tissues), 1 / len(tissues))
    share = np.where(stiff, _INTACT / max(stiff.sum(), 1), (1 - _INTACT) / max((~stiff).sum(), 1))
    return np.asarray(share, np.float64)


def weigh_tissues(scene: MethodContext, seen: Sequence[Observation], own_mm: Floats) -> Film:
    """Tissues weighed by the strongest frames; Poisson's ratio at the likeliest edge and membrane."""
    strongest = sorted(seen, key=lambda one: -one.signal_mm)[: 3 * _STRONGEST : 3] or list(seen[:1])
    strongest = [one for one in strongest if one.size_mm > 0]

    def evidence(tissue: TissueKind) -> float:
        basis = posterior.load_basis(len(own_mm), tissue)
        return _TEMPER * sum(posterior.infer(basis, one, own_mm).evidence for one in strongest)

    tissues = list(grid_of(scene))
    score = [
        evidence(one) + np.log(prior)
        for one, prior in zip(tissues, _prior(tissues, scene.membrane), strict=True)
    ]
    best = int(np.argmax(score))
    low, high = scene.poisson
    others = [nu for nu in _POISSON if low <= nu <= high and nu != tissues[best].poisson]
    told = evidence(tissues[best]) if others else 0.0
    score[best] -= np.log(1 + len(others))  # they share what it was thought beforehand
    for nu in others:
        tissues.append(replace(tissues[best], poisson=nu))
        score.append(score[best] + evidence(tissues[-1]) - told)
    weight = softmax(score)
    kept = np.argsort(-weight)[: max(1, min(2, int((weight > _LEAST).sum())))]
    covered = float(weight @ [one.membrane > _THIN for one in tissues])
    return Film(tuple(tissues[k] for k in kept), weight[kept] / weight[kept].sum(), own_mm, covered)


def infer(film: Film, seen: Observation) -> Posterior:
    """A frame's loads, the tissues mixed by their weights."""
    found = [
        posterior.infer(posterior.load_basis(len(film.own_mm), one), seen, film.own_mm)
        for one in film.tissues
    ]
    return Posterior(
        float(film.weight @ [one.evidence for one in found]),
        mix([one.force for one in found], film.weight),
        sum((share * one.load for share, one in zip(film.weight, found, strict=True)), np.zeros(())),
    )


@lru_cache(maxsize=1)
def _places() -> Floats:
    points = posterior.load_basis(2, TissueKind()).known.points
    return np.asarray(points.T[::-1] / GRID.pitch_mm + (GRID.size - 1) / 2, np.float64)


def observe(moved: Field, spread: Field, mask: Field) -> Observation:
    """At the compliance's points, displacement and its deviation (C, N, N) mm on `GRID`; mask (N, N)."""
    at = _places()
    inside = map_coordinates(mask, at, order=1, mode="constant") > 0.5
    values = [
        np.stack([map_coordinates(part, at, order=1, mode="nearest") for part in parts]).astype(np.float64)
        for parts in (moved, spread)
    ]
    return Observation(np.where(inside, values[0], 0.0), np.where(inside, values[1], np.inf))


def describe(film: Film, scene: MethodContext) -> str:
    """What the film says of the tissue, for a person."""
    edge, nu = film.tissues[0].edge, film.tissues[0].poisson
    said = f"its edge {edge}, Poisson's ratio {nu:g}"
    if scene.membrane != "unknown":
        return f"a membrane is stated: {scene.membrane}; {said}"
    unit = "mm times E" if scene.young_kpa is None else "mN/mm"
    young = assumed_young(scene.young_kpa) if scene.young_kpa else 1.0
    bare, covered = max(1 - film.membrane, 1e-3), max(film.membrane, 1e-3)
    if covered <= bare:
        least = f"no evidence for a membrane above {_THIN * young:.2g} {unit}"
        return f"{least}, odds {bare / covered:.3g} : 1 against; {said}"
    stiff = np.array([one.membrane for one in film.tissues])
    thick, about = stiff > _THIN, ""
    if thick.any():
        about = f" of about {float(np.average(stiff[thick], weights=film.weight[thick])) * young:.2g} {unit}"
    return f"evidence for a membrane{about}, odds {covered / bare:.3g} : 1; {said}"
