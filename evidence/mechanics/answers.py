"""What reads the force in `bench experiment mechanics`: fitted in one world or all, asked in every one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evidence import kept
from evidence.end_to_end import models
from evidence.end_to_end.models import Answer
from evidence.end_to_end.pipelines import errors
from evidence.mechanics.worlds import FINE, MIXTURE, PLAIN, WORLDS, Scenes, coarse, rendered
from learn.data.clips import Clip
from learn.loss import Objective
from learn.settings import Settings, preset
from learn.settings import replace as changed
from learn.training.threads import set_threads

RIDGE, NETWORK, PHYSICS, NOTHING = models.RIDGE, "d2fnet-s", models.PHYSICS, "no force at all"
ON_PLAIN, ON_MIXTURE, SHUFFLED, UNFITTED = "plain", "mixture", "plain, labels dealt out anew", "nothing"
FLOWS = ("ideal", "recovered")
Floats = NDArray[np.float64]
Errors = dict[str, dict[str, list[float | None]]]
"""World → part → error of every sequence [%]; None: it was refused."""
PARTS = {
    "across": "the force across the line of sight",
    "scaled": "the same, times the one factor that fits the sequence best",
    "whole": "the force",
}
"""The second is what is left where the stiffness that a recording shows is calibrated."""


@dataclass(frozen=True)
class Reader:
    """One that is asked for the force."""

    model: str
    fit: str
    flow: str

    @property
    def slug(self) -> str:
        return f"{self.model}-{self.fit}-{self.flow}".replace(", ", "-").replace(" ", "-")


def readers() -> list[Reader]:
    """The dearest first: a pool is then done soonest."""
    fits = (ON_PLAIN, ON_MIXTURE)
    made = [Reader(NETWORK, fit, flow) for fit in fits for flow in FLOWS]
    made += [Reader(PHYSICS, UNFITTED, "recovered")]
    made += [Reader(RIDGE, fit, flow) for fit in fits for flow in FLOWS]
    return [*made, Reader(RIDGE, SHUFFLED, "recovered"), Reader(NOTHING, UNFITTED, "recovered")]


def network_settings(epochs: int, seed: int) -> Settings:
    """Of d2fnet-s on a small grid, of vectors: it and the ridge are scored alike."""
    live = preset("live")
    return changed(
        live,
        size=FINE.size,
        # On vectors the loss without ghosts leaves less than squared error (docs/results/learn).
        arch=changed(live.arch, output="vector"),
        objective=Objective(kind="mse"),
        learning_rate=2e-3,
        schedule="cosine",
        channels_last=True,
        input="recovered",
        epochs=epochs,
        seed=seed,
    )


@dataclass(frozen=True)
class Trial:
    """Who is fitted on what, asked what, and where that stays."""

    fit: Scenes
    """Their first sequences choose a network's epoch."""
    test: Scenes
    """Of another seed: no anatomy of theirs is fitted."""
    epochs: int

    def wanted(self) -> list[tuple[Scenes, str, int]]:
        """Every sequence that is needed: scenes, world and index; those that fewer suffice for come first."""
        names = dict.fromkeys(one for name in WORLDS for one in rendered(name))
        asked = [(self.test, name, k) for name in names for k in range(self.test.count)]
        fitted = [(self.fit, name, k) for k in range(self.fit.count) for name in (PLAIN, mixed(k))]
        return sorted([*asked, *dict.fromkeys(fitted)], key=lambda one: one[2] / one[0].count)

    def errors(self, one: Reader) -> Errors:
        """What a reader errs by in every world."""
        set_threads(1)
        fitted = [] if one.fit == UNFITTED else self._fitted_on(one)
        tests = {name: [self.test.clip(name, k) for k in range(self.test.count)] for name in WORLDS}

        def compute() -> Errors:
            answer = self._answer(one, fitted)
            return {name: _asked(answer, one, clips) for name, clips in tests.items()}

        seen = [clip.content_hash for clip in fitted]
        asked = {name: [clip and clip.content_hash for clip in clips] for name, clips in tests.items()}
        key = kept.word(__name__, one.slug, self.settings.as_dict(), seen, asked)
        found: Errors = kept.result(self.fit.work / "answers", one.slug, key, compute)
        return found

    @property
    def settings(self) -> Settings:
        return network_settings(self.epochs, self.fit.seed)

    def _fitted_on(self, one: Reader) -> list[Clip]:
        world = mixed if one.fit == ON_MIXTURE else lambda k: PLAIN
        clips = [self.fit.clip(world(k), k) for k in range(self.fit.count)]
        there = [_read(clip, one) for clip in clips if clip is not None]
        return dealt_out(there, self.fit.seed) if one.fit == SHUFFLED else there

    def _answer(self, one: Reader, fitted: Sequence[Clip]) -> Answer:
        if one.model == NOTHING:
            return lambda clip: np.zeros((clip.frames, 3))
        if one.model != NETWORK:
            return models.build(one.model, fitted, Path(), self.epochs, self.fit.seed)
        seen = kept.word(__name__, self.settings.as_dict(), [clip.content_hash for clip in fitted])
        return models.train_network(fitted, self.settings, self.fit.work / "networks" / f"{one.slug}-{seen}")


def mixed(index: int) -> str:
    """The world of a sequence of the mixture: each in turn."""
    return MIXTURE[index % len(MIXTURE)]


def dealt_out(clips: Sequence[Clip], seed: int) -> list[Clip]:
    """The clips with each other's force, none with its own, as of tissue of its own stiffness."""
    order = np.random.default_rng(seed).permutation(len(clips))
    giver = {int(a): clips[int(b)] for a, b in zip(order, np.roll(order, 1), strict=True)}
    return [
        replace(
            clip,
            force=giver[k].force * (clip.young_kpa / giver[k].young_kpa),
            density=giver[k].density,
            content_hash=f"{clip.content_hash}-{giver[k].content_hash}",
        )
        for k, clip in enumerate(clips)
    ]


def _read(clip: Clip, one: Reader) -> Clip:
    """The clip as a reader gets it: its flow under the name of the recovered one, on its grid."""
    moved, sure = clip.displacement[one.flow], clip.confidence
    if one.flow == "ideal":
        sure = np.ones_like(sure)
    clip = replace(clip, displacement={"recovered": moved}, confidence=sure)
    for _ in range({NETWORK: 0, PHYSICS: 1}.get(one.model, 2)):
        clip = coarse(clip)
    return clip


def _asked(answer: Answer, one: Reader, clips: Sequence[Clip | None]) -> dict[str, list[float | None]]:
    found: dict[str, list[float | None]] = {part: [] for part in PARTS}
    for clip in clips:
        off = None if clip is None else errors_of(answer(_read(clip, one)), clip.force)
        for part in PARTS:
            found[part].append(None if off is None else round(100 * off[part], 1))
    return found


def errors_of(said: Floats, force: Floats) -> dict[str, float]:
    """Root mean square errors of one sequence as a part of its force, (T, 3) mN both, by part."""
    off = errors([said], [force])
    across, true = said[:, :2], force[:, :2]
    gain = max(float(np.vdot(across, true)) / max(float(np.vdot(across, across)), 1e-12), 0.0)
    scaled = np.square(gain * across - true).sum() / np.square(force).sum()
    return {"whole": off["errors"][0], "across": off["across"][0], "scaled": float(np.sqrt(scaled))}


def as_array(values: Sequence[float | None]) -> Floats:
    """(S,) of 1, from %; NaN for a sequence that was refused."""
    return np.array([np.nan if value is None else value / 100 for value in values])
