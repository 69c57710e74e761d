"""Networks that come with the package: `mono` of one eye, `stereo` of two, each a folder in `MODELS`."""

from __future__ import annotations

import hashlib
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
LARGEST_BYTES = 4_000_000
"""Of a network that comes along, all of its files."""
NONE = "no trained network comes with this version; train one: learn train DATASET --out model"


def shipped() -> dict[str, Path]:
    """The networks that are there, by name."""
    return {name: MODELS / name for name in NAMES if (MODELS / name / "config.json").is_file()}


def find_model(named: Path | str) -> Path:
    """The folder of a model that somebody named: his own, else of what comes along.

    Raises UserError if he means one that could come along, and doesn't.
    """
    if str(named) not in NAMES or Path(named).exists():
        return Path(named)
    if str(named) not in shipped():
        raise UserError(f"{named}: no such folder, and {NONE}")
    return shipped()[str(named)]


def choose_model(stereo: bool) -> Path | None:
    """The one to use where none is named: `stereo` for what two eyes saw, else `mono`; None if not there."""
    found = shipped()
    return next((found[name] for name in ("stereo", "mono")[not stereo :] if name in found), None)


def require_model(stereo: bool) -> Path:
    """As `choose_model`. UserError if none comes along."""
    found = choose_model(stereo)
    if found is None:
        raise UserError(f"say a model (--model): {NONE}")
    return found


def find_name(card: ModelCard) -> str:
    """The name of the network that comes along with these very weights; empty if it is none of them."""
    found = {checkpoint.read_card(folder).weights_hash: name for name, folder in shipped().items()}
    return found.get(card.weights_hash, "")


def hash_data(card: ModelCard) -> str:
    """Of all sequences that a model was fitted, chosen and to be tested on; their order doesn't count."""
    named = {part: sorted(hashes) for part, hashes in card.split.items()}
    return hashlib.blake2b(identity.canonical(named), digest_size=16).hexdigest()


def pack_model(
    model: Path, folder: Path, commit: str, metrics: Mapping[str, str], limits: Sequence[str]
) -> ModelCard:
    """Writes a trained model as one that comes along: weights.safetensors, config.json and a card, README.md.

    Args:
        model: folder of `learn train`.
        folder: of the new one, `MODELS` and its name; replaced if it is there.
        commit: of the code that trained it.
        metrics: what was measured, and the figure with its unit.
        limits: what it can't do, a sentence each.

    Raises:
        UserError: the model is damaged, or larger than `LARGEST_BYTES`; nothing is left then.
    """
    net, card = checkpoint.read_model(model)
    shutil.rmtree(folder, ignore_errors=True)
    card = checkpoint.write_model(folder, card, net.state_dict(), safe=True)
    write_whole(folder / "README.md", _readme(folder.name, card, commit, metrics, limits).encode())
    size = folder_bytes(folder)
    if size > LARGEST_BYTES:
        shutil.rmtree(folder)
        raise UserError(
            f"{model}: takes {size / 1e6:.1f} MB, what comes along at most {LARGEST_BYTES / 1e6:g}; "
            "train it with a smaller arch.width"
        )
    return card


def describe(card: ModelCard) -> str:
    """A line for a person."""
    settings, arch = card.settings, card.settings.arch
    eyes = "two eyes" if arch.depth else "one eye"
    return (
        f"{eyes}, {arch.output}, {settings.size}² cells, {settings.extent_mm:g} mm, input {settings.input}; "
        f"R² {card.score:.3f} on sequences that chose it, {len(card.split.get('fit', []))} fitted"
    )


def _readme(
    name: str, card: ModelCard, commit: str, metrics: Mapping[str, str], limits: Sequence[str]
) -> str:
    line = describe(card)
    rows = {"data (hash of its sequences)": hash_data(card), "commit": commit, **metrics}
    table = "\n".join(f"| {what} | {value} |" for what, value in rows.items())
    listed = "\n".join(f"- {one}" for one in limits)
    head = f"# {name}\n\n{line[:1].upper()}{line[1:]}.\n\n| what | |\n| --- | --- |\n"
    return f"{head}{table}\n\nLimits:\n\n{listed}\n"
