"""Clips of displacement and force on the network's grid, and who is trained on."""
