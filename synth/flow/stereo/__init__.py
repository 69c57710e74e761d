"""Stereo and depth cameras: rest disparity, and motion in three dimensions with its standard deviation."""
