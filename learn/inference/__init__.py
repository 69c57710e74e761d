"""A trained model applied: to stores, videos, arrays, other programs."""
