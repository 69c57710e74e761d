"""Learning measured: losses, networks, controls, and where it breaks."""
