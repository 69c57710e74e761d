"""Content of domain randomisation: patterns, surroundings and lamps wider than reality."""
