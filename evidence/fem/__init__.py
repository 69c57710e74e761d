"""The physics measured: error against cost, and where it breaks."""
