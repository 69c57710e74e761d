"""A dataset of two short sequences that comes with the package.

It was made by `synth render tiny -o sample store.flow=float16 store.without=[depth]` and zipped.
"""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.system import cache, checked_file

_ARCHIVE = Path(__file__).with_name("sample.zip")


def sample() -> Dataset:
    """Two sequences of six frames of 160 × 120 px, to read without rendering anything.

    They are unpacked into this user's cache once. Raises PermissionError if no folder is writable.

        flow = synth.sample()[0]["flow"][3]  # (120, 160, 2) px
    """
    name = hashlib.blake2b(_ARCHIVE.read_bytes(), digest_size=8).hexdigest()
    folder = cache.folder("sample") / name
    if not folder.exists():
        try:
            with checked_file.folder_of(folder) as part:
                shutil.unpack_archive(_ARCHIVE, part)
        except (OSError, UserError):
            if not folder.exists():  # else another process was faster
                raise
    return Dataset(folder)
