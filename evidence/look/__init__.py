"""The look against a photograph: texture, a classifier of patches, and what a fit finds again."""
