"""Learning force maps from displacement."""
