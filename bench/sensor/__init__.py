"""The force sensor: its samples, its clock and its axes."""
