"""A trained model, and the force map that it predicts from one frame's motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from learn import checkpoint
from learn.checkpoint import ModelCard
from learn.data.clips import FIELDS, has_depth
from learn.data.grid import Grid, GridView, certainty, channels, membrane_code
from learn.inference.shipped import find_model
from learn.network.d2fnet import freeze, fused
from learn.uncertainty.features import motion_features
from synth.arguments import checked
from synth.arrays import Floats, Map, Mask
from synth.errors import UserError, as_positive, as_user_error
from synth.flow.stereo.track import Moved
from synth.job.types import MembraneState
from synth.plugins import check_answer


@checked
def load_model(name: Path | str, device: torch.device | str = "cpu", *, quick: bool = False) -> Predictor:
    """A trained model, to be called frame by frame (`Predictor`) or for a whole video (`predict_force`).

    Args:
        name: the folder that `learn train` wrote, or `mono` or `stereo` for a pretrained network.
        device: PyTorch's name of the device.
        quick: compile the network in a second so that it runs a fifth faster on a CPU.

    Raises:
        UserError: the folder is missing, damaged or edited.
    """
    network, card = checkpoint.read_model(find_model(name))
    return Predictor(network, card, device, quick)


class Predictor:
    """A trained model for pictures of any size and scale."""

    def __init__(self, network: nn.Module, card: ModelCard, device: torch.device | str, quick: bool) -> None:
        """`quick`: as of `load_model`."""
        self.card, self.grid = card, card.settings.grid
        with as_user_error(f"device {device}"):
            self.device = torch.device(device)
            self.model = fused(network).to(self.device)
        self._network: Callable[..., Any] = self.model
        if quick and self.device.type == "cpu":
            self._network = freeze(network, card.settings.arch, card.settings.size)
        self._view: GridView | None = None

    def readable(self, source: str) -> str:
        """The source of displacement as given. Raises UserError if this model can't use it."""
        fit = [name for name in FIELDS if has_depth(name) == self.card.settings.arch.depth]
        if source not in fit:
            what = "this model can't use" if source in FIELDS else "unknown"
            raise UserError(f"{what} input {source!r}: one of {', '.join(fit)}")
        return source

    def stored(self, source: str | None) -> str:
        """The source to read from a store; the recovered one if none is given. Raises as `readable`."""
        return self.readable(source or ("motion" if self.card.settings.arch.depth else "recovered"))

    @checked
    def __call__(
        self,
        flow: Map,
        tissue: Mask,
        scale_mm_per_px: float,
        young_kpa: float | None = None,
        confidence: Map | None = None,
        moved: Moved | None = None,
        *,
        centre_px: tuple[float, float] | None = None,
        membrane: MembraneState = "unknown",
    ) -> ForceMap:
        """Force map of one frame.

        Args:
            flow: (H, W, 2) px, motion from the rest frame on the rest frame's pixels.
            tissue: (H, W) bool.
            scale_mm_per_px: of the picture.
            young_kpa: of the tissue; None: the training data's typical value.
            confidence: (H, W) 0..1, used only by a model with that channel; None: 1.
            moved: motion in three dimensions and its deviation, which a stereo model uses instead of flow and
                confidence.
            centre_px: as of `GridView`.
            membrane: as of `density`.

        Raises:
            UserError: other shapes, values that aren't finite, or a stereo model without `moved`.
        """
        young = self.card.typical_young_kpa if young_kpa is None else as_positive("young_kpa", young_kpa)
        if self._view is None or not self._view.matches(tissue, scale_mm_per_px, centre_px):
            self._view = GridView(tissue, scale_mm_per_px, self.grid, centre_px)
        view = self._view
        displacement, cell_confidence = self.on_grid(view, flow, confidence, moved)
        known = None if cell_confidence is None else cell_confidence[None]
        density = self.density(displacement[None], view.mask, young, known, membrane)
        motion = None
        if self.card.intervals is not None:
            motion = motion_features(displacement[None], view.mask, known, self.grid.extent_mm)[0]
        return ForceMap(density[0], self.grid, young, young_kpa is not None, view, motion)

    def on_grid(
        self, view: GridView, flow: Map, confidence: Map | None = None, moved: Moved | None = None
    ) -> tuple[Map, Map | None]:
        """Displacement (C, N, N) mm of a frame and its confidence (C - 1, N, N); arguments as `__call__`."""
        height, width = view.tissue.shape
        if flow.shape != (height, width, 2):
            raise UserError(f"flow: expected ({height}, {width}, 2), got {flow.shape}")
        if confidence is not None:
            confidence = check_answer("Predictor", "confidence", confidence, (height, width), (0.0, 1.0))
        if not self.card.settings.arch.depth:
            shift = view.mean(flow.transpose(2, 0, 1) * view.scale_mm_per_px)
            return shift, None if confidence is None else view.mean(confidence)[None]
        if moved is None:
            raise UserError("this model needs motion in three dimensions: give it stereo or depth images")
        for what, values in (("motion", moved.motion), ("its deviation", moved.deviation)):
            if values.shape != (height, width, 3):
                raise UserError(f"{what}: expected ({height}, {width}, 3), got {values.shape}")
        return view.mean(moved.motion.transpose(2, 0, 1)), view.mean(certainty(moved.deviation))

    @torch.inference_mode()
    def density(
        self,
        displacement: Map,
        mask: Map,
        young_kpa: float,
        confidence: Map | None = None,
        membrane: MembraneState = "unknown",
    ) -> Map:
        """Force density of frames already on the grid, (T, C, N, N) mN/mm² at `young_kpa`.

        Args:
            displacement: (T, 2, N, N) mm, for a stereo model (T, 3, N, N).
            mask: (N, N) 0/1.
            young_kpa: of the tissue.
            confidence: (T, 1, N, N), with depth (T, 2, N, N); None: 1.
            membrane: state of the membrane; used only by a model with `arch.membrane`.

        Raises:
            UserError: another grid or number of components, or non-finite values or predictions.
        """
        n, settings, scales = self.grid.size, self.card.settings, self.card.scales
        parts = settings.arch.displacements
        if displacement.ndim != 4 or displacement.shape[1:] != (parts, n, n):
            raise UserError(
                f"this model needs displacement of shape (T, {parts}, {n}, {n}) "
                f"[{', '.join(('dx', 'dy', 'dz')[:parts])} in mm], got {displacement.shape}"
            )
        if not np.isfinite(displacement).all():
            raise UserError("displacement holds NaN or infinity")
        maps = []
        for start in range(0, len(displacement), settings.batch):
            frames = slice(start, start + settings.batch)
            u = torch.from_numpy(np.array(displacement[frames])).to(self.device)
            m = torch.from_numpy(np.array(mask)).to(self.device).expand(len(u), 1, n, n)
            c = codes = None
            if settings.arch.confidence:
                c = torch.ones_like(m).expand(-1, parts - 1, -1, -1)
                if confidence is not None:
                    c = torch.from_numpy(np.array(confidence[frames])).to(self.device)
            if settings.arch.membrane:
                codes = torch.full_like(u[:, 0, 0, 0], membrane_code(membrane))
            predicted = self._network(channels(u, m, self.grid.pitch_mm, scales, c, codes))
            maps.append(predicted.float().cpu().numpy())
        with np.errstate(over="ignore", invalid="ignore"):  # checked below
            density = np.concatenate(maps) * np.float32(scales.target * self.card.force_gain * young_kpa)
        if not np.isfinite(density).all():
            raise UserError("the model predicts NaN or infinity: its weights or scales are invalid")
        return density


@dataclass(frozen=True)
class ForceMap:
    """A model's force map of one frame."""

    density: Map
    """(C, N, N): force density [mN per mm² of the picture plane], C = 1 its length or 3 its x, y, z in
    camera axes."""
    grid: Grid
    young_kpa: float
    """Young's modulus that the map is for: the one given, else the training data's typical one."""
    young_known: bool
    view: GridView
    motion: Floats | None = None
    """(F,) `motion_features` of the frame, by a model with intervals."""

    @property
    def magnitude(self) -> Map:
        """(N, N), ≥ 0, in mN/mm²."""
        return length(self.density)

    @property
    def force_mn(self) -> Floats | None:
        """(3,) total force on the tissue in camera axes [mN]; None if the model gives no direction."""
        return total_force(self.density[None], self.grid)[0] if len(self.density) == 3 else None

    @property
    def total_force_mn(self) -> float:
        """Size of the total force [mN]."""
        return float(force_size(total_force(self.density[None], self.grid))[0])

    def to_image(self) -> Map:
        """Magnitude on the picture's pixels, (H, W), 0 outside the grid."""
        return self.view.to_image(self.magnitude)


def length(density: Map) -> Map:
    """Length over the component axis (..., C, N, N); the value itself if there is one component."""
    one = density.shape[-3] == 1
    return density.squeeze(-3) if one else np.asarray(np.sqrt(np.square(density).sum(-3)))


def total_force(density: Map, grid: Grid) -> Floats:
    """Total force (T, 3) mN, camera axes, of maps (T, C, N, N) mN/mm²; without direction the size and NaN."""
    total = density.astype(np.float64).sum((2, 3)) * grid.pitch_mm**2
    return total if total.shape[1] == 3 else np.pad(total, ((0, 0), (0, 2)), constant_values=np.nan)


def net_force(density: Map, at_rest: Map, grid: Grid) -> Floats:
    """`total_force` minus that of `at_rest` (1, C, N, N), the prediction for no motion; a size is ≥ 0."""
    net = total_force(density, grid) - total_force(at_rest, grid)
    return net if density.shape[1] == 3 else np.maximum(net, 0.0)


def force_size(force_mn: Floats) -> Floats:
    """(T,) size of forces (T, 3) of `total_force`."""
    return np.asarray(np.sqrt(np.nansum(force_mn**2, axis=-1)))
