"""A trained model on disk: config.json, weights.safetensors, network.onnx, history.jsonl; to resume, last.pt.

The card, config.json, holds hashes of the weights, of the ONNX network that `learn predict` and `bench` run,
and of itself, so that a change of any is detected. PyTorch is imported only where weights are used.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError
from safetensors import numpy as safetensors

from learn.data.clips import RECOVERED, sources
from learn.data.grid import Scales
from learn.network.registry import build
from learn.settings import TrainingSettings
from learn.uncertainty.intervals import Intervals
from synth.errors import UserError, as_user_error
from synth.formats import MODEL, check_format
from synth.job import identity
from synth.job.types import Positive
from synth.system import checked_file
from synth.system.checked_file import write_whole
from synth.system.config_file import first_mistake

if TYPE_CHECKING:
    from torch import Tensor, nn

_FORMAT = "sulcus-model"
_LARGEST_BYTES = 100_000_000  # of config.json, which lists the training sequences: a million of them
_LARGEST_WEIGHTS = 64 << 30
_LARGEST_ONNX = 2 << 30  # that the format allows
_WEIGHTS, _NEXT, _ONNX = "weights.safetensors", "weights.next.safetensors", "network.onnx"
_digest: Any = partial(hashlib.blake2b, digest_size=16)
_GAINS, _MODULI, _SCALES = (0.01, 100.0), (1e-3, 1e4), (1e-9, 1e9)  # limits of a card's numbers
USED = ("fit", "select", "intervals", "start")  # parts of `ModelCard.split` that it must not be scored on


@dataclass(frozen=True)
class ModelCard:
    """A model's settings, scales, split and intervals: enough to use it without its training data."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    settings: TrainingSettings
    scales: Scales
    typical_young_kpa: Positive  # geometric mean of E in the training data, used where E is unknown
    split: dict[str, list[str]]
    """Content hashes of the sequences by use: `fit` (weights), `select` (epoch, gain), `test`, `intervals`,
    and `start` (those of the model that training began with)."""
    groups: dict[str, list[str]]  # the anatomies of each part: other sequences of those are not unseen either
    dataset_splits: list[str] = field(default_factory=list)  # hash of each training dataset's split
    epoch: Annotated[int, Field(ge=0)] = 0
    score: FiniteFloat = 0.0
    """R² of the network's map, before `force_gain`, on the select sequences at the stored epoch."""
    force_gain: Positive = 1.0
    """Factor on the network's map: the slope through the origin of the true on the predicted total force, on
    the select sequences at the stored epoch."""
    weights_hash: str = ""  # of the file of weights; empty before the first epoch is stored
    onnx_hash: str = ""  # of network.onnx, made from these weights; empty: there is none
    intervals: Intervals | None = None  # prediction intervals; None if not fitted
    no_intervals: str = ""  # why they could not be fitted; else empty
    motion: list[str] = field(default_factory=list)
    """Estimators and versions of the motion of its training, as of `name_motion`; empty: true, or unknown."""

    def doubt(self, recovered_by: str) -> list[str]:
        """A note if the network was not, or not surely, trained on motion like that, for which its intervals
        are then not calibrated. `recovered_by`: as of `name_motion`; "": true motion, or unknown."""
        exact = not {*RECOVERED}.intersection(sources(self.settings.input))
        if recovered_by in self.motion or (not recovered_by and (exact or self.motion)):
            return []
        kind = " and ".join(self.motion) or ("true" if exact else "")
        training = (
            f"was trained on {kind} motion" if kind else "does not state the motion that it was trained on"
        )
        suffix = f", and this is by {recovered_by}" if recovered_by else ""
        return [
            f"the network {training}{suffix}: forces may be off, its intervals are not calibrated; "
            "train it again on a dataset of this version"
        ]

    @property
    def used(self) -> set[str]:
        """Content hashes of the sequences that the model must not be scored on."""
        return {content for part in USED for content in self.split.get(part, [])}


_CARD = TypeAdapter(ModelCard)


def write_card(folder: Path, card: ModelCard) -> None:
    """Writes config.json into a model's folder, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = {"format": _FORMAT, "format_version": MODEL, **_CARD.dump_python(card, mode="json")}
    tree["seal"] = identity.digest(tree)
    _write(folder / "config.json", (json.dumps(tree, indent=1) + "\n").encode())


def write_model(folder: Path, card: ModelCard, state: Mapping[str, Tensor]) -> ModelCard:
    """Writes weights and card atomically and returns the card with the weights' hash."""
    folder.mkdir(parents=True, exist_ok=True)
    data = safetensors.save({name: np.asarray(value, order="C") for name, value in state.items()})
    card = replace(card, weights_hash=_digest(data).hexdigest(), onnx_hash="")
    _write(folder / _NEXT, data)
    write_card(folder, card)
    os.replace(folder / _NEXT, folder / _WEIGHTS)
    return card


def read_card(folder: Path) -> ModelCard:
    """A folder's card. Raises UserError if it is missing, damaged, edited or of another version."""
    file = folder / "config.json"
    if not file.exists():
        raise UserError(f"{folder}: no model here (config.json is missing)")
    data = checked_file.read_bytes(file, _LARGEST_BYTES)
    try:
        tree = json.loads(data)
        if tree.pop("seal", None) != identity.digest(tree):
            raise UserError(f"{file}: edited or damaged: its seal does not match")
        if tree.pop("format") != _FORMAT:
            raise UserError(f"{file}: not a Sulcus model")
        check_format(tree.pop("format_version", 1), MODEL, str(file))
        card = _CARD.validate_json(json.dumps(tree), strict=True)
        _refuse_absurd(card, file)
        return card
    except ValidationError as error:
        raise UserError(f"{file}: damaged or of another version ({first_mistake(error)})") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{file}: corrupt model configuration ({str(error)[:200]})") from None


def _refuse_absurd(card: ModelCard, file: Path) -> None:
    """Raises UserError for a number that no training gives, and that would make every force infinite or 0."""
    numbers = {
        "force_gain": (card.force_gain, _GAINS),
        "typical_young_kpa": (card.typical_young_kpa, _MODULI),
    }
    numbers |= {f"scales.{name}": (value, _SCALES) for name, value in vars(card.scales).items()}
    if card.intervals is not None:
        numbers["intervals.force_unit"] = card.intervals.force_unit, _SCALES
    for name, (value, (low, high)) in numbers.items():
        if not low <= value <= high:
            raise UserError(f"{file}: {name} {value:g}: must be from {low:g} to {high:g}")


def write_onnx(folder: Path, card: ModelCard, data: bytes) -> ModelCard:
    """Writes the ONNX network of a model's weights, and the card, which is returned with its hash."""
    card = replace(card, onnx_hash=_digest(data).hexdigest())
    _write(folder / _ONNX, data)
    write_card(folder, card)
    return card


def read_onnx(folder: Path, card: ModelCard) -> bytes | None:
    """A model's ONNX network; None: it has none. UserError if it is damaged or of other weights."""
    if not card.onnx_hash:
        return None
    data = checked_file.read_bytes(folder / _ONNX, _LARGEST_ONNX)
    if _digest(data).hexdigest() != card.onnx_hash:
        raise UserError(f"{folder / _ONNX}: not the network that config.json was written for, or damaged")
    return data


def read_tensors(path: Path) -> dict[str, Any]:
    """The tensors and plain values that `torch.save` wrote, by name, on the CPU. UserError for others."""
    import torch

    with checked_file.open_file(path, _LARGEST_WEIGHTS) as file, as_user_error(f"{path}: corrupt checkpoint"):
        with zipfile.ZipFile(file) as archive:  # PyTorch ignores checksums
            if sum(entry.file_size for entry in archive.infolist()) > os.fstat(file.fileno()).st_size:
                raise ValueError("compressed")
            if (damaged := archive.testzip()) is not None:
                raise ValueError(f"a checksum of {damaged} does not match")
        try:
            file.seek(0)
            tree = torch.load(file, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:  # its message advises to load them all the same
            raise ValueError("holds other objects than tensors and plain values") from None
        if not isinstance(tree, dict):
            raise TypeError("holds no state")
        return tree


def save_tensors(file: Path, tree: Mapping[str, Any]) -> None:
    """Writes tensors and plain values atomically. Raises UserError if the file can't be written."""
    import torch

    buffer = io.BytesIO()
    torch.save(dict(tree), buffer)
    _write(file, buffer.getvalue())


def read_model(folder: Path) -> tuple[nn.Module, ModelCard]:
    """The trained network, in evaluation mode on the CPU, and its card. UserError: damaged or edited."""
    import torch

    card = read_card(folder)
    file = _find_weights(folder, card)
    with as_user_error(f"{file}: corrupt weights"):
        state = safetensors.load(checked_file.read_bytes(file, _LARGEST_WEIGHTS))
    if _shapes(card.settings) != {name: value.shape for name, value in state.items()}:
        raise UserError(f"{file}: the weights are not those of the network in config.json")
    if not all(np.isfinite(value).all() for value in state.values()):
        raise UserError(f"{file}: the weights hold NaN or infinity")
    model = build(card.settings.network, card.settings.arch)
    model.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})
    return model.eval(), card


def disk_needed(folder: Path, settings: TrainingSettings) -> int:
    """Upper bound of the bytes that a training still adds to `folder`."""
    numbers = sum(math.prod(shape) for shape in _shapes(settings).values())
    # Weights, ONNX, and last.pt with the weights and two moments of each; all twice during replacement. Logs.
    needed = 2 * 5 * 4 * numbers + 2_000_000
    files = (folder / name for name in (_WEIGHTS, _ONNX, "last.pt"))
    return max(needed - sum(file.stat().st_size for file in files if file.is_file()), 1)


def _shapes(settings: TrainingSettings) -> dict[str, tuple[int, ...]]:
    import torch
    from torch.overrides import TorchFunctionMode

    class WithoutInitialisation(TorchFunctionMode):
        """Random numbers for tensors without memory would import torch's compiler, for seconds."""

        def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            kwargs, draws = kwargs or {}, (torch.Tensor.normal_, torch.Tensor.uniform_)
            if func in draws or getattr(func, "__module__", "") == "torch.nn.init":
                return args[0] if args else kwargs["tensor"]
            return func(*args, **kwargs)

    with torch.device("meta"), WithoutInitialisation():
        state = build(settings.network, settings.arch).state_dict()
    return {name: tuple(value.shape) for name, value in state.items()}


def _find_weights(folder: Path, card: ModelCard) -> Path:
    """The file whose hash the card holds; the next one if writing was interrupted."""
    for file in (folder / _WEIGHTS, folder / _NEXT):
        if file.is_file():
            with checked_file.open_file(file, _LARGEST_WEIGHTS) as stream:
                if hashlib.file_digest(stream, _digest).hexdigest() == card.weights_hash:
                    return file
    if not (folder / _WEIGHTS).is_file():
        raise UserError(f"{folder / _WEIGHTS}: no such file")
    raise UserError(f"{folder / _WEIGHTS}: not the weights that config.json was written for, or damaged")


def _write(file: Path, data: bytes) -> None:
    with as_user_error(f"{file}: cannot be written"):
        write_whole(file, data)
