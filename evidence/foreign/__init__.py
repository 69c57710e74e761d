"""Recordings that other programs make: mechanics by felupe, pictures by Blender, each in its own Python."""
