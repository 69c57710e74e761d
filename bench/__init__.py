"""Scoring recordings and comparing methods."""
