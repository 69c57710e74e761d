"""Optical flow: estimators of displacement, masks, tracking from the rest frame."""
