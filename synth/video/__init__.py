"""Films of others: read, written, their masks and scale."""
