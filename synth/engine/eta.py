"""How long the rest of a run will take: as long a sequence as the latest took, not the slow first ones."""

from __future__ import annotations

from collections import deque

# So many of the latest sequences, beyond one a worker, say how fast it goes.
_LATEST = 32


class Pace:
    """Told when sequences end. The first of a worker process also starts it and compiles what it runs."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._ends = deque([0.0], maxlen=workers + _LATEST + 1)
        self.ended = 0
        """Sequences that ended."""

    def end(self, at_s: float) -> None:
        """A sequence ended, so many seconds after the run began."""
        self._ends.append(at_s)
        self.ended += 1

    @property
    def cold(self) -> bool:
        """Whether there are only first sequences to go by: then `left_s` is too long."""
        return self.ended < 2 * self._workers

    def left_s(self, left: int) -> float | None:
        """Seconds that `left` more sequences will take; None before any has ended."""
        if not self.ended:
            return None
        ends = list(self._ends)
        # Their first ones are left out once every worker has ended another.
        warm = ends if self.cold else ends[self._workers :]
        return (warm[-1] - warm[0]) / (len(warm) - 1) * left
