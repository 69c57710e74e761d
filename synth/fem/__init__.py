"""Mechanics: from a gesture to the motion of the surface and the traction on it."""
