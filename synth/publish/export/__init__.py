"""The dataset in the formats of others, for the libraries that read them."""
