"""One pass over a video: displacement from the rest frame."""
