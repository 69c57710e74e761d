"""Checks of a recording: what is usable, missing, doubtful or wrong."""
