"""Checks of a dataset's integrity and physical consistency."""
