"""Recordings made by other programs: mechanics by felupe, images by Blender, each in its own Python."""
