"""The stages of a job alone in one process: no engine, no store, no index, no card.

It imports no more than a worker does, whose start counts in the same measurement.
"""

import sys
from pathlib import Path
from typing import Any
from unittest import mock

from synth.job.schema import Job
from synth.sequence import pipeline


class _Nowhere:
    """Accepts every call of a store and stores nothing."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def render_bare(described: str) -> None:
    """Renders the sequences of a job, given as JSON."""
    job = Job.model_validate_json(described)
    with mock.patch.object(pipeline, "Writer", _Nowhere):
        for index in range(job.sequences):
            pipeline.render_sequence(job, index, Path("."), lambda *_: None)


if __name__ == "__main__":
    render_bare(sys.argv[1])
