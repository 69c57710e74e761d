"""The sim-to-real gap, and what leakage does to a score."""
