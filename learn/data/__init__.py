"""Clips of displacement and force on the network's grid."""
