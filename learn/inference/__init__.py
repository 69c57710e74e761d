"""A trained model applied to stores, videos and arrays, and exported to other programs."""
