"""The search of the most likely tissue: the largest of all, with half of them looked at."""

import numpy as np
import pytest

from bench.methods.compliance import Edge, TissueKind
from bench.methods.tissue_weights import TISSUES, TissueWeights, find_largest

EDGES: tuple[Edge, ...] = ("bonded", "slipping")


@pytest.mark.parametrize("seed", range(20))
def test_the_most_likely_tissue_is_that_of_all(seed: int) -> None:
    """Evidence falls off on both sides of a stiffness that differs from edge to edge."""
    rng, visited = np.random.default_rng(seed), set[TissueKind]()
    candidates = [
        TissueKind(edge, membrane, 0.45, stretch)
        for edge in EDGES
        for membrane in TISSUES.membranes_mm[1:]
        for stretch in TISSUES.stretches
    ]
    optimum = dict(zip(EDGES, rng.uniform(np.log(3), np.log(400), 2), strict=True))
    edge_gain, stretch_gain = rng.normal(size=2)

    def value(tissue: TissueKind) -> float:
        visited.add(tissue)
        gain = edge_gain * (tissue.edge == "slipping") + stretch_gain * (tissue.stretch > 1)
        return float(gain - (np.log(tissue.membrane) - optimum[tissue.edge]) ** 2)

    answer = find_largest(candidates, value)
    assert len(visited) < len(candidates)
    assert answer == max(candidates, key=value)


def test_a_single_candidate_is_the_answer() -> None:
    candidate = TissueKind("bonded", 0.0, 0.45)
    assert find_largest([candidate], lambda _: 0.0) == candidate


def test_the_stiffness_of_large_motion_ignores_tissues_without_a_membrane() -> None:
    tissues = TissueKind(membrane=40.0), TissueKind(), TissueKind(membrane=10.0)
    own_mm = np.zeros((2, 6, 0))
    middle = TissueWeights(tissues, np.array([0.5, 0.25, 0.25]), own_mm, False).middle
    assert middle.membrane == pytest.approx(40 ** (2 / 3) * 10 ** (1 / 3), rel=1e-2)
    assert TissueWeights(tissues[1:], np.array([0.5, 0.5]), own_mm, False).middle == TissueKind()
