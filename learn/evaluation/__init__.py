"""Scores of a model, with their confidence intervals, and the fit of its prediction intervals."""
