"""Scoring measured: pseudo ex vivo recordings, cost, physics alone."""
