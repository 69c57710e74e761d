"""The pretrained network of force, `stereo` (two cameras), a folder in `MODELS`: an example, as physics errs
less on other programs' recordings."""

from __future__ import annotations

from pathlib import Path

from learn import checkpoint
from learn.checkpoint import ModelCard
from synth.job import identity

MODELS = Path(__file__).parents[1] / "models"
NAMES = ("stereo",)
LICENCE = "Apache-2.0"
"""Of the shipped weights, as of the code: they were trained on this project's renders alone."""


def find_model(name: Path | str) -> Path:
    """The folder of a model: a folder of that name, else of the pretrained network."""
    return MODELS / name if str(name) in NAMES and not Path(name).exists() else Path(name)


def find_name(card: ModelCard) -> str:
    """The name of the pretrained network with the same weights; empty if there is none."""
    names = {checkpoint.read_card(MODELS / name).weights_hash: name for name in NAMES}
    return names.get(card.weights_hash, "")


def hash_data(card: ModelCard) -> str:
    """Hash of all sequences in a model's split, in any order."""
    return identity.digest({part: sorted(hashes) for part, hashes in card.split.items()})


def describe(card: ModelCard) -> str:
    """A one-line summary of a model."""
    settings, arch, motion = card.settings, card.settings.arch, " and ".join(card.motion)
    return (
        f"{'stereo' if arch.depth else 'monocular'}, {arch.output}, {settings.size}² cells, "
        f"{settings.extent_mm:g} mm, input {settings.input} ({motion or 'version unknown'}); R² "
        f"{card.score:.3f} on validation sequences, {len(card.split.get('fit', []))} training sequences"
    )
