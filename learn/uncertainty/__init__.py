"""Prediction intervals of forces, and out-of-distribution detection."""
