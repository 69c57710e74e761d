"""A clip of given motion and force."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learn.data.clips import Clip


def made_clip(
    name: object, moved: NDArray[Any], force: NDArray[Any], mask: NDArray[Any] | None = None
) -> Clip:
    """`moved`: (T, 2, N, N) mm, ideal and recovered; `force`: (T, 3) mN; full confidence, E 2 kPa."""
    frames, _, n, _ = moved.shape
    moved = moved.astype(np.float32)
    return Clip(
        name=str(name),
        content_hash=str(name),
        group=str(name),
        young_kpa=2.0,
        mask=np.ones((n, n), np.float32) if mask is None else mask,
        displacement={"ideal": moved, "recovered": moved},
        confidence=np.ones((frames, n, n), np.float32),
        density=np.zeros((frames, 3, n, n), np.float32),
        force=force,
    )
