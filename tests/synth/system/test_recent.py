"""Results kept in memory: found by content, bounded in number and size."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from synth.system.recent import Recent


@dataclass(frozen=True)
class Plate:
    height: NDArray[np.float64]
    name: str
    springs: sp.csr_array


def make_plate(height: float = 1.0, name: str = "a", spring: float = 1.0) -> Plate:
    return Plate(np.full((2, 3), height), name, spring * sp.csr_array(np.eye(3)))


def test_equal_content_is_computed_once_and_any_other_anew() -> None:
    recent, counter = Recent[int](8, lambda number: 0), iter(range(100))
    plates = [make_plate(), make_plate(2.0), make_plate(name="b"), make_plate(spring=2.0)]
    results = [recent.get(lambda: next(counter), plate, 3) for plate in plates]
    assert results == [0, 1, 2, 3]
    assert [
        recent.get(lambda: next(counter), make_plate(), 3),
        recent.get(lambda: next(counter), make_plate(), 4),
    ] == [0, 4]
    flat, tall = np.zeros((2, 3)), np.zeros((3, 2))
    assert (
        len({recent.get(lambda: next(counter), array) for array in (flat, tall, flat.astype(np.float32))})
        == 3
    )


def test_few_and_small_results_are_kept() -> None:
    recent, counter = Recent[int](2, lambda number: 10 * number, largest=50), iter(range(1, 100))

    def ask(key: str) -> int:
        return recent.get(lambda: next(counter), key)

    assert [ask(key) for key in "ababcbca"] == [1, 2, 1, 2, 3, 2, 3, 4]  # the oldest left for the third
    assert [ask(key) for key in "defdef"] == [5, 6, 7, 5, 8, 9]  # results from 6 on are too large
