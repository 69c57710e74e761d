from __future__ import annotations

import torch
from clip_fixtures import clips, dataset

__all__ = ["clips", "dataset"]

torch.set_num_threads(1)
