"""The look against a photograph: a classifier of patches."""
