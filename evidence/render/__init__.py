"""The renderer measured: cost, truth, noise, likeness, and where it breaks."""
