"""The ends of intervals over a film, as `learn predict` writes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learn.inference.force_reader import ForceReader
from learn.inference.predict import ForceMap
from learn.uncertainty.conformal import LEVELS

_HIGH, _LOW = LEVELS


class Ends:
    """Gathers them frame by frame; empty for a model without intervals."""

    def __init__(self, reader: ForceReader) -> None:
        """`reader`: of the film."""
        self._reader = reader
        self._rows: dict[str, list[NDArray[np.floating]]] = {}

    def add(self, force: NDArray[np.float64], said: ForceMap, trusted: bool) -> None:
        """The next frame: its force (3,) mN as read, and whether it could be followed."""
        if said.motion is None:
            return
        # What could not be followed shows no world; its intervals are blanked below.
        wide = self._reader.bound(force, said, counted=trusted)
        of_map = self._reader.bound_map(force, said)
        assert wide is not None
        assert of_map is not None
        row = {
            "low_mn": wide[_HIGH].low[0],
            "high_mn": wide[_HIGH].high[0],
            "low68_mn": wide[_LOW].low[0],
            "high68_mn": wide[_LOW].high[0],
            "force_low_mn": wide[_HIGH].axes_low[0],
            "force_high_mn": wide[_HIGH].axes_high[0],
            "density_low": of_map[0],
            "density_high": of_map[1],
        }
        for name, value in row.items():
            self._rows.setdefault(name, []).append(value)

    def stacked(self, trusted: NDArray[np.bool_]) -> dict[str, NDArray[np.floating]]:
        """By name, one value a frame; NaN where `trusted` (T,) is False; the map has no gaps."""
        out = {name: np.array(values) for name, values in self._rows.items()}
        for name, values in out.items():
            if name.endswith("_mn"):
                values[~trusted] = np.nan
        return out
