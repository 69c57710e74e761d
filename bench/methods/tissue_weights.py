"""Which tissues a video's motion may come from, and how likely each is.

What meta.yaml leaves open - how the skull holds the tissue's edge, whether it has a membrane and how stiff
that is, Poisson's ratio - is weighted by the evidence of the frames with the largest motion; a frame's loads
are a mixture over the likely ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_softmax, softmax

from bench.methods import posterior
from bench.methods.compliance import OPENING_MM, Edge, TissueKind
from bench.methods.force_mixture import mix
from bench.methods.method_interface import MethodContext
from bench.methods.posterior import LoadBasis, Observation, Posterior
from learn.data.clips import UNKNOWN_YOUNG_KPA
from synth.arrays import Floats
from synth.flow.recording.find_tissue import measure_border_share


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
    unlikely: float = 1e-6  # least weight of an assumption that the interval is to hold


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
        np.tensordot(weight, [answer.load for answer in posteriors], axes=1),
        np.tensordot(
            weights.weight, [answer.own_amplitudes for answer in posteriors[: len(weights.tissues)]], axes=1
        ),
    )


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
