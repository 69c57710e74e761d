"""Recordings: reading, writing and checking folders of video, force sensor and description."""
