"""The pretrained networks, `mono` (one camera) and `stereo`, each a folder in `MODELS`."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from learn import checkpoint
from learn.checkpoint import ModelCard
from synth.errors import UserError
from synth.job import identity
from synth.system.checked_file import folder_bytes, write_whole

MODELS = Path(__file__).parents[1] / "models"
NAMES = ("mono", "stereo")
LARGEST_BYTES = 4_000_000  # of all files of a pretrained network


def find_model(named: Path | str) -> Path:
    """The folder of a model: a folder of that name, else of the pretrained network."""
    return MODELS / named if str(named) in NAMES and not Path(named).exists() else Path(named)


def choose_model(stereo: bool) -> Path:
    """The default network's folder, for recordings of one camera or stereo ones."""
    return MODELS / NAMES[stereo]


def find_name(card: ModelCard) -> str:
    """The name of the pretrained network with the same weights; empty if there is none."""
    found = {checkpoint.read_card(MODELS / name).weights_hash: name for name in NAMES}
    return found.get(card.weights_hash, "")


def hash_data(card: ModelCard) -> str:
    """Hash of all sequences in a model's split, in any order."""
    named = {part: sorted(hashes) for part, hashes in card.split.items()}
    return identity.digest(named)


def pack_model(
    model: Path, folder: Path, commit: str, metrics: Mapping[str, str], limits: Sequence[str]
) -> ModelCard:
    """Writes a pretrained network: weights.safetensors, config.json and a card, README.md.

    Args:
        model: folder of `learn train`.
        folder: of the pretrained network, `MODELS` and its name; replaced if it exists.
        commit: of the code that trained it.
        metrics: name and value of each measurement, with its unit.
        limits: known limits, a sentence each.

    Raises:
        UserError: the model is damaged, or larger than `LARGEST_BYTES`; nothing is written then.
    """
    net, card = checkpoint.read_model(model)
    shutil.rmtree(folder, ignore_errors=True)
    card = checkpoint.write_model(folder, card, net.state_dict())
    line = describe(card)
    rows = {"data (hash of its sequences)": hash_data(card), "commit": commit, **metrics}
    table = "\n".join(f"| {what} | {value} |" for what, value in rows.items())
    listed = "\n".join(f"- {one}" for one in limits)
    head = f"# {folder.name}\n\n{line[:1].upper()}{line[1:]}.\n\n| what | |\n| --- | --- |\n"
    write_whole(folder / "README.md", f"{head}{table}\n\nLimits:\n\n{listed}\n".encode())
    size = folder_bytes(folder)
    if size > LARGEST_BYTES:
        shutil.rmtree(folder)
        raise UserError(
            f"{model}: is {size / 1e6:.1f} MB, a pretrained network at most {LARGEST_BYTES / 1e6:g}; "
            "train it with a smaller arch.width"
        )
    return card


def describe(card: ModelCard) -> str:
    """A one-line summary of a model."""
    settings, arch, motion = card.settings, card.settings.arch, " and ".join(card.motion)
    return (
        f"{'stereo' if arch.depth else 'monocular'}, {arch.output}, {settings.size}² cells, "
        f"{settings.extent_mm:g} mm, input {settings.input} ({motion or 'version unknown'}); R² "
        f"{card.score:.3f} on validation sequences, {len(card.split.get('fit', []))} training sequences"
    )
