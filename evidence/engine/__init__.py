"""The engine measured: cost, kills, damage, faults, size."""
