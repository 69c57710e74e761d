"""Datasets on disk: stores, folder, index, split, and readers."""
