"""Appearance: a classifier that distinguishes patches of renderings from those of a photograph."""
