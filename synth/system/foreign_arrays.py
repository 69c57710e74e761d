"""Arrays of others: .npz files, read whole or refused in a line."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.system import foreign_file

_LARGEST_BYTES = 64 << 30


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz by name, of any shape (A, ...), of numbers and truth values only.

    Raises:
        UserError: no regular file, no .npz, damaged, too large for the memory, or an array of something else.
    """
    try:
        with foreign_file.open_file(path, _LARGEST_BYTES) as file, np.lib.npyio.NpzFile(file) as held:
            found = {name: held[name] for name in held.files}
    except (
        OSError, ValueError, EOFError, KeyError, NotImplementedError, MemoryError, RuntimeError,
        zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        said = (str(error).splitlines() or [""])[0][:200]
        raise UserError(f"{path}: cannot be read as .npz ({said or type(error).__name__})") from None
    for name, array in found.items():
        # A member that is no .npy comes as its bytes.
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise UserError(f"{path}: {name} is no array of numbers")
    return found
