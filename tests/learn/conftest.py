from __future__ import annotations

from clip_fixtures import clips, dataset

__all__ = ["clips", "dataset"]
