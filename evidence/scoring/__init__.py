"""Scoring measured: ex vivo stand-ins, cost, fusion, pulse removal, degraded recordings."""
