"""The force sensor: its samples and its clock."""
