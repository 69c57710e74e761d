"""Force estimators: networks, baselines, physics and their fusion."""
