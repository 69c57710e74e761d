from __future__ import annotations

from clip_fixtures import dataset

__all__ = ["dataset"]
