"""A network fitted to one specimen, from a recording's rest frame and meta.yaml, never from its sensor."""
