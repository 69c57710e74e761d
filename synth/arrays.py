"""Types of arrays. Their shapes and units are stated where they are used."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats = NDArray[np.float64]
Map = NDArray[np.float32]
Ints = NDArray[np.int64]
Indices = NDArray[np.int32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
