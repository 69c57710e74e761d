"""Synthesis of surgical-microscope sequences with exact physical ground truth."""
