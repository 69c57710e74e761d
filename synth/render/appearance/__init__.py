"""Appearance of a sequence: families of colour and wetness, lamps, reflections."""
