"""Versions of the formats on disk: a changed meaning raises its number, and N reads N and N - 1."""

import hashlib
from functools import cache
from pathlib import Path

from synth.errors import UserError

STORE, FOLDER, MODEL, SCORE = 2, 4, 2, 2
"""Of a sequence store, a dataset's `dataset.json`, a model's `config.json`, a recording's `score.json`."""
MOTION = 8
"""Of recovered motion: raised when flow, masks or stereo recover another motion from the same pictures, since
networks learn the errors of the motion that they were trained on."""
MESH, CONTENT, COMPLIANCE, CLIPS, TRAINING, SCORING = 1, 9, 1, 1, 2, 10
"""Of computed values, on which caches and datasets depend next to their inputs: the volume mesh; what a job
renders (mechanics, pictures, labels); the matrices of physics; packed clips; what a training returns; what
`bench score` returns. Each is raised with a change that moves its probe of the guard (`make guard`)."""
MOTION_WEIGHTS = Path(__file__).with_name("flow")  # folder of the networks on which motion depends
FIRST = 2  # written by 0.2, the first release: nothing older is read


@cache
def motion_version() -> str:
    """Version of recovered motion, `MOTION` and a digest of the weights below it: `4-0a1b2c3d`."""
    weights = b"".join(file.read_bytes() for file in sorted(MOTION_WEIGHTS.rglob("*.onnx")))
    return f"{MOTION}-{hashlib.blake2b(weights, digest_size=4).hexdigest()}"


def check_format(version: object, current: int, label: str) -> None:
    """Raises UserError if the format version `version` in `label` is neither `current` nor the one before."""
    readable = [number for number in (current, current - 1) if number >= FIRST]
    if type(version) is not int or version not in readable:
        known = " and ".join(map(str, readable))
        raise UserError(
            f"{label}: written by format {str(version)[:40]}; this version reads {known}: create it again, "
            "or use the version that wrote it"
        )
