"""Processing of the force sensor: samples, clock and axes."""
