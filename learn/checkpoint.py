"""A trained model on disk: a folder with config.json, weights.pt, history.jsonl and what resuming needs.

A model that comes with the package has weights.safetensors instead, which any program can read. The card,
config.json, holds a hash of the weights and one of itself, so that neither can change unseen.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError
from safetensors import torch as safetensors
from torch import Tensor

from learn.data.grid import Scales
from learn.network.d2fnet import Architecture, D2FNet
from learn.settings import TrainingSettings
from learn.uncertainty.intervals import Intervals
from synth.errors import UserError, as_user_error
from synth.formats import MODEL, check_format
from synth.job import identity
from synth.job.types import Positive
from synth.system import checked_file
from synth.system.checked_file import write_whole
from synth.system.config_file import first_mistake

_FORMAT = "sulcus-model"
_LARGEST_BYTES = 100_000_000
"""Of config.json, which names the sequences that were trained on: a million of them."""
_LARGEST_WEIGHTS = 64 << 30
_WEIGHTS, _NEXT, _SAFE = "weights.pt", "weights.next.pt", "weights.safetensors"
_digest: Any = partial(hashlib.blake2b, digest_size=16)
SEEN = ("fit", "select", "intervals")
"""Parts of `ModelCard.split` that no score of the model may be of."""


@dataclass(frozen=True)
class ModelCard:
    """What a model says of itself: enough to use it without the data it came from."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    settings: TrainingSettings
    scales: Scales
    typical_young_kpa: Positive
    """Geometric mean of E in the training data: stands in where E is unknown."""
    split: dict[str, list[str]]
    """Content hashes of the sequences that were fitted (`fit`), that chose the epoch (`select`), that were
    left (`test`), and, if any, that were kept for intervals (`intervals`)."""
    groups: dict[str, list[str]]
    """The anatomies of each, so that a sequence of a seen anatomy is never taken for unseen."""
    dataset_splits: list[str] = field(default_factory=list)
    """Hash of the split of each dataset that it was trained on."""
    epoch: Annotated[int, Field(ge=0)] = 0
    score: FiniteFloat = 0.0
    """R² on the select sequences at the chosen epoch, of the network's own map, before `force_gain`."""
    force_gain: Positive = 1.0
    """What the network's map is multiplied by: the slope through the origin of the true on the predicted
    total force, on the select sequences at the chosen epoch."""
    weights_hash: str = ""
    """Of the file of weights; empty before an epoch is kept."""
    intervals: Intervals | None = None
    """How far off its answers may be; None where nobody fitted that, or it could not be."""
    no_intervals: str = ""
    """Why it could not be; empty if it could, or nobody tried."""

    @property
    def seen(self) -> set[str]:
        """Content hashes of the sequences that no score of the model may be of."""
        return {content for part in SEEN for content in self.split.get(part, [])}


_CARD = TypeAdapter(ModelCard)


def write_card(folder: Path, card: ModelCard) -> None:
    """Writes config.json into a model's folder, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = {"format": _FORMAT, "format_version": MODEL, **_CARD.dump_python(card, mode="json")}
    tree["seal"] = _hash(identity.canonical(tree))
    _write(folder / "config.json", (json.dumps(tree, indent=1) + "\n").encode())


def write_model(
    folder: Path, card: ModelCard, state: Mapping[str, Tensor], *, safe: bool = False
) -> ModelCard:
    """Writes weights and card, so that a kill leaves the old ones or the new ones; the card as written.

    `safe`: as weights.safetensors, into a folder that holds no model yet.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = safetensors.save({k: v.contiguous() for k, v in state.items()}) if safe else _packed(state)
    card = replace(card, weights_hash=_hash(data))
    _write(folder / (_SAFE if safe else _NEXT), data)
    write_card(folder, card)
    if not safe:
        os.replace(folder / _NEXT, folder / _WEIGHTS)
    return card


def read_card(folder: Path) -> ModelCard:
    """Raises UserError if there is no model, or its config is damaged, edited or of another version."""
    file = folder / "config.json"
    if not file.exists():
        raise UserError(f"{folder}: no model here (config.json is missing)")
    data = checked_file.read_bytes(file, _LARGEST_BYTES)
    try:
        tree = json.loads(data)
        if tree.pop("seal", None) != _hash(identity.canonical(tree)):
            raise UserError(f"{file}: is not as it was written: edited or damaged")
        if tree.pop("format") != _FORMAT:
            raise UserError(f"{file}: not a model of ours")
        check_format(tree.pop("format_version", 1), MODEL, str(file))
        return _CARD.validate_json(json.dumps(tree), strict=True)
    except ValidationError as error:
        raise UserError(f"{file}: damaged or of another version ({first_mistake(error)})") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{file}: corrupt model configuration ({str(error)[:200]})") from None


def save_tensors(file: Path, tree: Mapping[str, Any]) -> None:
    """Tensors and plain values, whole or not at all. Raises UserError if the file can't be written."""
    _write(file, _packed(tree))


def load_tensors(file: Path) -> dict[str, Any]:
    """Raises UserError if the file is missing or damaged, or holds anything but tensors and plain values."""
    checked_file.check_file(file, _LARGEST_WEIGHTS)
    with as_user_error(f"{file}: corrupt checkpoint"):
        if file.suffix == ".safetensors":
            return dict(safetensors.load_file(file))
        _check_archive(file)
        tree = torch.load(file, map_location="cpu", weights_only=True)
        if not isinstance(tree, dict):
            raise TypeError("holds no state")
        return tree


def read_model(folder: Path) -> tuple[D2FNet, ModelCard]:
    """The trained network, in evaluation mode on the CPU, and its card.

    Raises UserError if card or weights are damaged, edited, or not each other's.
    """
    card = read_card(folder)
    state = load_tensors(_find_weights(folder, card))
    model = build_network(state, card.settings.arch, folder)
    if not all(torch.isfinite(v).all() for v in state.values()):
        raise UserError(f"{folder}: the weights hold NaN or infinity")
    return model.eval(), card


def build_network(state: Mapping[str, Any], arch: Architecture, where: Path) -> D2FNet:
    """The network of `arch` with the weights of `state`. Raises UserError, before it takes memory for them,
    if they aren't its own."""
    with torch.device("meta"):
        expected = {name: value.shape for name, value in D2FNet(arch).state_dict().items()}
    found = {name: value.shape for name, value in state.items() if isinstance(value, Tensor)}
    if len(found) != len(state) or found != expected:
        raise UserError(f"{where}: the weights are not those of the network in config.json")
    model = D2FNet(arch)
    with as_user_error(f"{where}: the weights can't be used"):
        model.load_state_dict(state)
    return model


def room_needed(folder: Path, arch: Architecture) -> int:
    """Bytes that a training of `arch` still takes on the disk of `folder`, at most."""
    with torch.device("meta"):
        numbers = sum(int(value.numel()) for value in D2FNet(arch).state_dict().values())
    # Weights, and last.pt with two moments of each beside them; all twice while they are replaced. And logs.
    needed = 2 * 4 * 4 * numbers + 2_000_000
    written = (folder / name for name in (_WEIGHTS, "last.pt"))
    return max(needed - sum(file.stat().st_size for file in written if file.is_file()), 1)


def _find_weights(folder: Path, card: ModelCard) -> Path:
    """The weights that the card was written for: under their next name if a kill came in between."""
    for file in (folder / _WEIGHTS, folder / _NEXT, folder / _SAFE):
        if file.is_file():
            with file.open("rb") as opened:
                if hashlib.file_digest(opened, _digest).hexdigest() == card.weights_hash:
                    return file
    file = folder / (_SAFE if (folder / _SAFE).exists() else _WEIGHTS)
    load_tensors(file)  # may say more of what is wrong
    raise UserError(f"{file}: not the weights that config.json was written for, or damaged")


def _check_archive(file: Path) -> None:
    """ValueError or what zipfile raises if a checksum of the archive is wrong, which PyTorch doesn't look at.

    Also if it would be larger in memory than on disk.
    """
    with zipfile.ZipFile(file) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > file.stat().st_size:
            raise ValueError("packed")
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"a checksum of {damaged} does not match")


def _packed(tree: Mapping[str, Any]) -> bytes:
    held = io.BytesIO()
    torch.save(dict(tree), held)
    return held.getvalue()


def _write(file: Path, data: bytes) -> None:
    """`write_whole`, a full disk as a UserError."""
    try:
        write_whole(file, data)
    except OSError as error:
        raise UserError(f"{file}: cannot be written ({error.strerror})") from None


def _hash(data: bytes) -> str:
    return str(_digest(data).hexdigest())
