"""The guard: short probes of the product, and by how much each has moved since a result was stored."""
