"""`from synth.store import Dataset`, the import that readers of a dataset know."""

from synth.dataset.store import Dataset, Sequence, open_sequence

__all__ = ["Dataset", "Sequence", "open_sequence"]
