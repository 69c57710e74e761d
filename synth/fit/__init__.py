"""Estimation of a photograph's camera parameters and of its nearest appearance family."""
