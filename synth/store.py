"""`from synth.store import Dataset, Frames`, the imports that readers of a dataset know."""

from synth.dataset.store import Dataset, Sequence, open_sequence
from synth.dataset.torch_dataset import Frames

__all__ = ["Dataset", "Frames", "Sequence", "open_sequence"]
