"""Checking a dataset against its own invariants."""
