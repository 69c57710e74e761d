"""Products of a finished dataset: card, exports, pictures, videos."""
