"""A trained model on disk: a folder with config.json, weights.pt, history.jsonl and what resuming needs."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import ConfigDict, TypeAdapter, ValidationError
from torch import nn

from learn.data.grid import Scales
from learn.network.monai_unet import build
from learn.settings import Settings
from synth.errors import UserError

_FORMAT, _VERSION = "sulcus-model", 1


@dataclass(frozen=True)
class Card:
    """What a model says of itself: enough to use it without the data it came from."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    settings: Settings
    scales: Scales
    typical_young_kpa: float
    """Geometric mean of E in the training data: stands in where E is unknown."""
    split: dict[str, list[str]]
    """Content hashes of the sequences that were fitted, that chose the epoch, and that were left."""
    groups: dict[str, list[str]]
    """The anatomies of each, so that a sequence of a seen anatomy is never taken for unseen."""
    epoch: int = 0
    score: float = 0.0
    """R² on the select sequences at the chosen epoch."""


_CARD = TypeAdapter(Card)


def write_card(folder: Path, card: Card) -> None:
    """Writes config.json into a model's folder, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = {"format": _FORMAT, "version": _VERSION, **_CARD.dump_python(card)}
    _replace(folder / "config.json", (json.dumps(tree, indent=1) + "\n").encode())


def read_card(folder: Path) -> Card:
    """Raises UserError if there is no model, or its config is damaged or of another version."""
    file = folder / "config.json"
    if not file.is_file():
        raise UserError(f"{folder}: no model here (config.json is missing)")
    try:
        tree = json.loads(file.read_text())
        if tree.pop("format") != _FORMAT or tree.pop("version") != _VERSION:
            raise UserError(f"{file}: not a model of this version")
        return _CARD.validate_python(tree)
    except ValidationError as error:
        wrong = [(one["type"], ".".join(map(str, one["loc"])), one["msg"]) for one in error.errors()]
        unknown = [at for kind, at, _ in wrong if kind in ("extra_forbidden", "unexpected_keyword_argument")]
        if unknown:
            raise UserError(
                f"{file}: made by another version of this program (no '{unknown[0]}' here)"
            ) from None
        raise UserError(f"{file}: corrupt model configuration ({wrong[0][1]}: {wrong[0][2]})") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{file}: corrupt model configuration ({error})") from None


def save_tensors(file: Path, tree: Mapping[str, Any]) -> None:
    """Tensors and plain values, written beside and renamed, so a kill leaves the old file."""
    part = file.with_suffix(file.suffix + f".part{os.getpid()}")
    torch.save(dict(tree), part)
    os.replace(part, file)


def load_tensors(file: Path) -> dict[str, Any]:
    """Raises UserError if the file is missing, truncated or holds anything but tensors and plain values."""
    if not file.is_file():
        raise UserError(f"{file}: missing")
    try:
        tree = torch.load(file, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError, OSError) as error:
        why = str(error).splitlines()[0].split(". ")[0]
        raise UserError(f"{file}: corrupt checkpoint ({why})") from None
    if not isinstance(tree, dict):
        raise UserError(f"{file}: corrupt checkpoint (holds no state)")
    return tree


def load_model(folder: Path) -> tuple[nn.Module, Card]:
    """The trained network, in evaluation mode on the CPU, and its card."""
    card = read_card(folder)
    model = build(card.settings.arch)
    state = load_tensors(folder / "weights.pt")
    try:
        model.load_state_dict(state)
    except RuntimeError:
        raise UserError(f"{folder}: the weights are not those of the network in config.json") from None
    if not all(torch.isfinite(v).all() for v in state.values()):
        raise UserError(f"{folder}: the weights hold NaN or infinity")
    return model.eval(), card


def _replace(file: Path, data: bytes) -> None:
    part = file.with_suffix(file.suffix + f".part{os.getpid()}")
    part.write_bytes(data)
    os.replace(part, file)
