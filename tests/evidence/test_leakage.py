"""A method that only remembers looks good when frames are dealt at random, and not when recordings are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Console

from bench.methods import baselines
from evidence.gap import leakage
from learn.data.clips import Clip


def clips(count: int = 12, frames: int = 16) -> list[Clip]:
    """Each with a field of its own that grows with the force, whose gain is drawn: nothing carries over."""
    rng = np.random.default_rng(0)
    n = baselines.GRID.size
    out = []
    for k in range(count):
        field = rng.normal(size=(2, n, n)).astype(np.float32)
        level = np.linspace(0.1, 1, frames)
        force = np.zeros((frames, 3))
        force[:, 0] = level * rng.uniform(1, 20)
        moved = (level[:, None, None, None] * field).astype(np.float32)
        density = np.zeros((frames, 3, n, n), np.float32)
        out.append(
            Clip(
                name=str(k), content_hash=str(k), group=str(k), family="", gesture="", young_kpa=1.0,
                mask=np.ones((n, n), np.float32), displacement={"recovered": moved},
                confidence=np.ones((frames, n, n), np.float32), density=density, force=force,
            )
        )  # fmt: skip
    return out


def remembering(clips: Sequence[Clip], source: str) -> dict[str, baselines.Rule]:
    """Answers with the force of the most similar frame it has seen."""
    seen = np.concatenate([c.displacement[source].reshape(c.frames, -1) for c in clips])
    force = np.concatenate([c.force for c in clips])
    return {"memory": lambda moved, mask, sure: force[np.square(seen - moved.ravel()).sum(axis=1).argmin()]}


def test_remembering_is_only_rewarded_by_random_frames() -> None:
    data = clips()
    found = {
        name: leakage.answers(data, fold, Console(quiet=True), remembering)
        for name, fold in (
            ("random frames", leakage._by_frame(data, 0)),
            ("whole recordings", leakage._by_recording(data, 0)),
        )
    }
    values = leakage.summary(data, found)["methods"]["memory"]
    assert values["random frames"]["r2"] > 0.8
    assert values["whole recordings"]["r2"] < 0.2
    assert "memory" in leakage.drawn(leakage.summary(data, found)).text()
