"""The engine measured: what it costs over the bare stages."""
