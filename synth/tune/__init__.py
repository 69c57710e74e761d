"""Goal-oriented fidelity: no more than a scene needs."""
