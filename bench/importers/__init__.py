"""Recordings of other systems, turned into recording folders."""
