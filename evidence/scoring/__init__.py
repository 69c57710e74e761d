"""Scoring measured: ex vivo stand-ins, cost, fusion, degraded recordings."""
