"""Networks in ONNX files, run by ONNX Runtime, unless told otherwise on one thread.

PyTorch trains them (`weights.networks`). To run them it takes longer, and to import more than the flow
of a short sequence.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import onnxruntime

from synth.arrays import Map
from synth.errors import as_user_error
from synth.system import checked_file

_LARGEST = 1 << 24  # bytes of a file
_ERRORS_ONLY = 3


@cache
def load(path: Path) -> onnxruntime.InferenceSession:
    """The network of a file. UserError: it can't be read."""
    return open_network(checked_file.read_bytes(path, _LARGEST), str(path))


def open_network(data: bytes, label: str, threads: int = 1) -> onnxruntime.InferenceSession:
    """A network from a file's bytes, on so many threads. UserError that begins with `label`: it is none."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = _ERRORS_ONLY
    with as_user_error(f"{label}: not a network in ONNX"):
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def run(path: Path, planes: Map) -> Map:
    """Output (C', H', W') of the network of a file for one input (C, H, W) float32."""
    (output,) = load(path).run(None, {"planes": planes[None]})
    return np.asarray(output[0], np.float32)
