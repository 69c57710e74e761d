"""The worlds of the mechanics experiment: the same anatomy, contact, load and look, other mechanics.

Two sequences of one seed and index differ by their world alone: what is drawn for the one is drawn for the
other, and a number that a world doesn't need is drawn nevertheless (`synth.fem.material`).
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

FRAMES, FPS, SIZE, VERTICES = 8, 8.0, (192, 144), 8000
"""A second, as a sequence of the default job: a heart beats once or twice in it."""

PLAIN = "plain"
_UNTOUCHED = 1e-6  # load of a tool that does nothing


@dataclass(frozen=True)
class World:
    """Mechanics that tissue may have."""

    fem: Mapping[str, Any] = field(default_factory=dict)
    """What a job says of it, beside what all say."""
    without: str = ""
    """The world whose motion is taken off every frame, as a perfect pulse removal would."""
    mixed: bool = True
    """Whether it is in the mixture."""


def _membrane(young_kpa: float, thickness_mm: float) -> dict[str, Any]:
    return {"probability": 1.0, "young_kpa": young_kpa, "thickness_mm": thickness_mm}


_PULSE = {"heart_mm": [0.1, 0.5], "breath_mm": [0.1, 1.0]}
_ALIVE = {"pulse": _PULSE, "membrane": {"probability": 1.0}}

WORLDS: dict[str, World] = {
    PLAIN: World(),
    "membrane, 5 mN/mm": World({"membrane": _membrane(100.0, 0.05)}),
    "membrane, 200 mN/mm": World({"membrane": _membrane(1000.0, 0.2)}),
    "pulse": World({"pulse": _PULSE}),
    "pulse, taken off": World({"pulse": _PULSE}, without="pulse alone", mixed=False),
    "Poisson 0.49": World({"poisson": 0.49}),
    "slip at the skull": World({"skull": "slip"}),
    "in vivo": World(_ALIVE, mixed=False),
    "in vivo, taken off": World(_ALIVE, without="in vivo, alone", mixed=False),
}
"""All that are asked about. The membranes are the ends of the job's range of thickness times modulus;
`in vivo` is the job of that name, membrane and pulse together, which the mixture doesn't hold."""

_ALONE: dict[str, dict[str, Any]] = {"pulse alone": {"pulse": _PULSE}, "in vivo, alone": _ALIVE}
MIXTURE = [name for name, world in WORLDS.items() if world.mixed]


def job(name: str, seed: int, count: int) -> Job:
    """The job of a world's sequences; of one that is alone, no tool does anything and none of it is seen."""
    alone = name in _ALONE
    fem = _ALONE[name] | {"load": _UNTOUCHED} if alone else dict(WORLDS[name].fem)
    return Job.model_validate(
        {
            "seed": seed,
            "sequences": count,
            "frames": FRAMES,
            "fps": FPS,
            "anatomy": {"vertices": VERTICES},
            # The law that the default job chooses, whatever the load.
            "fem": {"gestures": ["pull", "push"], "law": "neo-hookean", **fem},
            "render": {"size": SIZE, "spp": 1 if alone else 4},
            "flow": {"backend": "ideal" if alone else "tvl1"},
        }
    )


@dataclass(frozen=True)
class Scenes:
    """Sequences of one seed in every world, packed as they are made."""

    seed: int
    count: int
    work: Path

    def make(self, name: str, index: int) -> str:
        """Renders a sequence that isn't there yet; gives back why it was refused, empty if it was not.

        Args:
            name: of `rendered`.
            index: which sequence.
        """
        asked, folder = job(name, self.seed, self.count), self._folder(name)
        packed = folder / f"{index:06d}"
        if _refusal(packed).is_file():
            return _refusal(packed).read_text("utf-8")
        if packed.is_dir():
            return ""
        folder.mkdir(parents=True, exist_ok=True)
        store = location.store(folder, index)
        for left in (store, store.with_suffix(".zarr.part")):
            shutil.rmtree(left, ignore_errors=True)
        try:
            pipeline.render_sequence(asked, index, folder, lambda stage, done, of: None)
        except UserError as refusal:
            write_whole(_refusal(packed), str(refusal), durable=False)
            return str(refusal)
        flows = ("ideal",) if name in _ALONE else ("ideal", "recovered")
        data.pack(data.read_clip(open_sequence(store), GRID, flows), packed)
        shutil.rmtree(store)
        return ""

    def clip(self, name: str, index: int) -> Clip | None:
        """A sequence of a world, with ideal and recovered displacement; None if it was refused.

        Raises:
            UserError: it was not made.
        """
        found = [self._packed(one, index) for one in rendered(name)]
        if any(clip is None for clip in found):
            return None
        clip, *own = (clip for clip in found if clip is not None)
        return taken_off(clip, own[0]) if own else clip

    def _packed(self, name: str, index: int) -> Clip | None:
        folder = self._folder(name) / f"{index:06d}"
        return None if _refusal(folder).is_file() else data.unpack(folder)

    def _folder(self, name: str) -> Path:
        made = cache.key(identity.identify_job(job(name, self.seed, self.count)), GRID.size, GRID.extent_mm)
        return self.work / f"{name.replace(', ', '-').replace(' ', '-').replace('/', '-')}-{self.seed}-{made}"


def rendered(name: str) -> tuple[str, ...]:
    """The worlds that must be rendered for one: itself, or another and what is taken off it."""
    world = WORLDS[name]
    if not world.without:
        return (name,)
    whole = next(n for n, other in WORLDS.items() if other.fem == world.fem and not other.without)
    return whole, world.without


def _refusal(packed: Path) -> Path:
    return packed.with_suffix(".refused")


def taken_off(clip: Clip, own: Clip) -> Clip:
    """A clip without the motion that the tissue has of its own: `own`'s ideal displacement, of every frame.

    What a removal of heart and breath would do that knows both exactly; it forgets that a tool's load and a
    pulse don't simply add in large strains.
    """
    beats = own.displacement["ideal"]
    return replace(
        clip,
        content_hash=f"{clip.content_hash}-{own.content_hash}",
        displacement={name: moved - beats for name, moved in clip.displacement.items()},
    )


def coarse(clip: Clip) -> Clip:
    """A clip on half as many cells each way: means over the tissue of four."""
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
