"""Conditions of the mechanics experiment: the same anatomy, contact, load and appearance, other mechanics.

Two sequences of one seed and index differ by their condition alone: they use the same random numbers, of
which some have no effect in some conditions (`synth.fem.material`).
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.methods.baselines import GRID
from evidence import cache
from learn.data import clips as data
from learn.data.clips import Clip
from synth.dataset import location
from synth.dataset.folder import write_whole
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.job import identity
from synth.job.schema import Job
from synth.sequence import pipeline

FRAMES, FPS, SIZE, VERTICES = 8, 8.0, (192, 144), 8000  # 1 s, one or two periods of the heart

PLAIN = "plain"
_UNTOUCHED = 1e-6  # load of a tool without effect


@dataclass(frozen=True)
class Condition:
    """Mechanical properties of tissue."""

    fem: Mapping[str, Any] = field(default_factory=dict)  # job keys in addition to the common ones
    without: str = ""  # the condition whose motion is subtracted, as by a perfect pulse removal
    mixed: bool = True  # whether it is in the mixture


_SOFT = {"probability": 1.0, "young_kpa": 100.0, "thickness_mm": 0.05}
_STIFF = {"probability": 1.0, "young_kpa": 1000.0, "thickness_mm": 0.2}
_PULSE = {"heart_mm": [0.1, 0.5], "breath_mm": [0.1, 1.0]}
_ALIVE = {"pulse": _PULSE, "membrane": {"probability": 1.0}}

CONDITIONS: dict[str, Condition] = {
    PLAIN: Condition(),
    "membrane, 5 mN/mm": Condition({"membrane": _SOFT}),
    "membrane, 200 mN/mm": Condition({"membrane": _STIFF}),
    "pulse": Condition({"pulse": _PULSE}),
    "pulse, removed": Condition({"pulse": _PULSE}, without="pulse alone", mixed=False),
    "Poisson 0.49": Condition({"poisson": 0.49}),
    "slip at the skull": Condition({"skull": "slip"}),
    "in vivo": Condition(_ALIVE, mixed=False),
    "in vivo, removed": Condition(_ALIVE, without="in vivo, alone", mixed=False),
}
"""All tested conditions. The membranes are the ends of the job's range of thickness times modulus; `in vivo`
is membrane and pulse together, as in the job of that name, and not in the mixture."""

_ALONE: dict[str, dict[str, Any]] = {"pulse alone": {"pulse": _PULSE}, "in vivo, alone": _ALIVE}
MIXTURE = [name for name, one in CONDITIONS.items() if one.mixed]


def job(name: str, seed: int, count: int) -> Job:
    """The job of a condition's sequences; in conditions of `_ALONE` the tool has no effect."""
    alone = name in _ALONE
    fem = _ALONE[name] | {"load": _UNTOUCHED} if alone else dict(CONDITIONS[name].fem)
    return Job.model_validate(
        {
            "seed": seed,
            "sequences": count,
            "frames": FRAMES,
            "fps": FPS,
            "anatomy": {"vertices": VERTICES},
            # The law of the default job, for every load.
            "fem": {"gestures": ["pull", "push"], "law": "neo-hookean", **fem},
            "render": {"size": SIZE, "spp": 1 if alone else 4},
            "flow": {"backend": "ideal" if alone else "tvl1"},
        }
    )


@dataclass(frozen=True)
class Scenes:
    """Sequences of one seed in every condition, packed as they are made."""

    seed: int
    count: int
    work: Path

    def make(self, name: str, index: int) -> str:
        """Renders sequence `index` of a condition of `rendered`, if it is missing.

        Returns the reason why it was refused, empty if it was not.
        """
        folder = self._folder(name)
        packed = folder / f"{index:06d}"
        if _refusal(packed).is_file():
            return _refusal(packed).read_text("utf-8")
        if packed.is_file():
            return ""
        folder.mkdir(parents=True, exist_ok=True)
        store = location.store(folder, index)
        for left in (store, store.with_suffix(".zarr.part")):
            shutil.rmtree(left, ignore_errors=True)
        try:
            wanted = job(name, self.seed, self.count)
            pipeline.render_sequence(wanted, index, folder, lambda stage, done, of: None)
        except UserError as refusal:
            write_whole(_refusal(packed), str(refusal), durable=False)
            return str(refusal)
        flows = ("ideal",) if name in _ALONE else ("ideal", "recovered")
        data.pack(data.read_clip(open_sequence(store), GRID, flows), packed)
        shutil.rmtree(store)
        return ""

    def clip(self, name: str, index: int) -> Clip | None:
        """A sequence of a condition, with ideal and recovered displacement; None if it was refused.

        Raises UserError: it was not made.
        """
        found = [self._packed(one, index) for one in rendered(name)]
        if any(clip is None for clip in found):
            return None
        clip, *own = (clip for clip in found if clip is not None)
        return subtracted(clip, own[0]) if own else clip

    def _packed(self, name: str, index: int) -> Clip | None:
        folder = self._folder(name) / f"{index:06d}"
        return None if _refusal(folder).is_file() else data.unpack(folder)

    def _folder(self, name: str) -> Path:
        made = cache.key(identity.identify_job(job(name, self.seed, self.count)), GRID.size, GRID.extent_mm)
        return self.work / f"{name.replace(', ', '-').replace(' ', '-').replace('/', '-')}-{self.seed}-{made}"


def rendered(name: str) -> tuple[str, ...]:
    """Conditions to render for one: itself, or another and the one that is subtracted from it."""
    one = CONDITIONS[name]
    if not one.without:
        return (name,)
    whole = next(n for n, other in CONDITIONS.items() if other.fem == one.fem and not other.without)
    return whole, one.without


def _refusal(packed: Path) -> Path:
    return packed.with_suffix(".refused")


def subtracted(clip: Clip, own: Clip) -> Clip:
    """A clip less the tissue's own motion, the ideal displacement of `own`, in every frame.

    This is the exact removal of pulse and respiration, except that displacements don't add linearly in large
    strains.
    """
    pulse = own.displacement["ideal"]
    return replace(
        clip,
        content_hash=f"{clip.content_hash}-{own.content_hash}",
        displacement={name: moved - pulse for name, moved in clip.displacement.items()},
    )


def coarse(clip: Clip) -> Clip:
    """A clip on half as many cells along each axis: means over the tissue of four cells."""
    share = _quarter(np.asarray(clip.mask))
    mask = (share > 0.5).astype(np.float32)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(_quarter(values * clip.mask) / np.maximum(share, 0.25) * mask, np.float32)

    return replace(
        clip,
        mask=mask,
        displacement={name: mean(np.asarray(moved)) for name, moved in clip.displacement.items()},
        confidence=mean(np.asarray(clip.confidence)),
        density=_quarter(np.asarray(clip.density)),
    )


def _quarter(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(..., 2 N, 2 N) → (..., N, N), the mean of four cells."""
    *front, height, width = values.shape
    return np.asarray(values.reshape(*front, height // 2, 2, width // 2, 2).mean(axis=(-3, -1)), np.float32)
