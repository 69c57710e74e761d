"""Tuning measured: whether fresh sequences stay within the budget."""
