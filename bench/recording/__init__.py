"""A recording: video, force sensor, description; read, written, checked."""
