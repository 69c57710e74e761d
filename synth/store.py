"""`from synth.store import Dataset, TorchDataset`, the imports that readers of a dataset know."""

from synth.dataset.store import Dataset, Sequence, open_sequence
from synth.dataset.torch_dataset import TorchDataset

Frames = TorchDataset
"""Its former name."""

__all__ = ["Dataset", "Frames", "Sequence", "TorchDataset", "open_sequence"]
