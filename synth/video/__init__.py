"""Films of others: read, written: pictures in and out, their masks and scale."""
