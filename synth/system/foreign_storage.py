"""Values of others that OpenCV wrote: FileStorage as YAML, XML or JSON."""

from __future__ import annotations

import re
from typing import Any

import cv2

from synth.errors import UserError

LARGEST = 1 << 20
"""Bytes of a calibration that is read."""
_DEEPEST = 50
_NESTING = re.compile(r"(?P<opens>[\[{]|<(?=\w)|[-?] +(?=[-?] )|\w: +(?=\w+: ))|[\]}]|</|/>")


def read_storage(name: str, text: str) -> dict[str, Any]:
    """The matrices (float64 arrays, as they were stored) and numbers at the top of a storage.

    Args:
        name: of the file, for what is said of it.
        text: what it holds.

    Raises:
        UserError: it is no storage, holds another kind of thing where a matrix is, or is nested too deep.
    """
    depth = deepest = 0
    for token in _NESTING.finditer(text):
        depth += 1 if token["opens"] else -1
        deepest = max(deepest, depth)
    if deepest > _DEEPEST:  # OpenCV's parser calls itself for each level, and ends the process
        raise UserError(f"{name}: is nested deeper than {_DEEPEST} levels")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        if not storage.isOpened() or not root.isMap():
            raise UserError(f"{name}: is no OpenCV calibration (YAML, XML or JSON)")
        found: dict[str, Any] = {}
        for key in root.keys():  # noqa: SIM118 - a FileNode is no dictionary
            node = root.getNode(key)
            if node.isMap():
                found[key] = node.mat()
            elif node.isInt() or node.isReal():
                found[key] = node.real()
        return found
    except (cv2.error, SystemError) as error:
        why = (str(error).strip().splitlines() or ["it is damaged"])[-1][:200]
        raise UserError(f"{name}: is no OpenCV calibration ({why})") from error
