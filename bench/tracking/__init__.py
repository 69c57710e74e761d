"""Tracking of recordings and streams, with the forces of methods."""
