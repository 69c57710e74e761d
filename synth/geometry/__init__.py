"""Surfaces as triangles: where they come from, and what is computed on them alone."""
