"""Flow between any two pictures, and flow files."""
