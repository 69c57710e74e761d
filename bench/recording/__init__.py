"""Recordings: reading and writing folders of video, force sensor and description."""
