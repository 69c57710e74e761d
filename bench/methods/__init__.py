"""What answers with a force: networks, baselines, physics."""
