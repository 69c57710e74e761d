"""The sim-to-real gap."""
