"""The dataset on disk: stores, folder, index, split, and the ways to read them."""
