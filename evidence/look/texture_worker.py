"""Texture statistics of crops. Run by `bench experiment texture` in a Python that has plenoptic."""

from __future__ import annotations

import sys

import numpy as np
import plenoptic  # type: ignore[import-not-found]
import torch

_AT_A_TIME = 32


def main(given: str, gives: str) -> None:
    """Reads crops (N, n, n) float32 and writes their statistics (N, S) float64."""
    torch.set_num_threads(1)
    crops = torch.from_numpy(np.load(given))[:, None].double()
    model = plenoptic.models.PortillaSimoncelli(crops.shape[-2:], n_scales=4, spatial_corr_width=7).double()
    with torch.no_grad():
        parts = [model(crops[k : k + _AT_A_TIME])[:, 0] for k in range(0, len(crops), _AT_A_TIME)]
    np.save(gives, torch.cat(parts).numpy())


if __name__ == "__main__":
    main(*sys.argv[1:])
