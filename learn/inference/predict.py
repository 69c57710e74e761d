"""A trained model, and the force map that it predicts from one frame's motion."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from learn import checkpoint
from learn.checkpoint import ModelCard
from learn.data.clips import FIELDS, has_depth
from learn.data.grid import Grid, GridView, certainty, membrane_code
from learn.inference.shipped_networks import find_model
from learn.uncertainty.features import motion_features
from synth.arguments import checked
from synth.arrays import Array, Floats, Map, Mask
from synth.errors import Caution, UserError, as_positive, as_user_error
from synth.flow import onnx_network
from synth.flow.stereo.stereo_track import Motion3D
from synth.formats import TRAINING
from synth.job import identity
from synth.job.types import MembraneState
from synth.plugins import check_answer
from synth.system import cache

_KEPT = 32  # networks in the user's cache


@checked
def load_model(name: Path | str, *, threads: int = 1) -> Predictor:
    """A trained model, to be called frame by frame (`Predictor`) or for a whole video (`predict_force`).

    Args:
        name: the folder that `learn train` wrote, or `stereo` for the pretrained network.
        threads: CPU threads of the network.

    Raises:
        UserError: the folder is missing, damaged or edited, or holds no trained network.
    """
    if threads < 1:
        raise UserError(f"threads {threads}: must be at least 1")
    folder = find_model(name)
    card = checkpoint.read_card(folder)
    data = checkpoint.read_onnx(folder, card)
    return Predictor(card, _convert(folder, card) if data is None else data, threads)


def _convert(folder: Path, card: ModelCard) -> bytes:
    """The ONNX network of a model that has none, made from its weights and kept in the user's cache."""

    def make() -> bytes:
        from learn.inference.convert import convert  # PyTorch, which nothing else here needs

        reason = "holds its weights for PyTorch only: they are converted to ONNX once, into the user's cache"
        warnings.warn(f"{folder}: {reason}", Caution, stacklevel=2)
        return convert(folder)

    # The file holds the networks' code too, whose version is TRAINING.
    inputs = {"settings": card.settings.model_dump(mode="json"), "scales": asdict(card.scales)}
    key = identity.digest({"weights": card.weights_hash, "code": TRAINING, **inputs}).encode()
    return cache.load_or_make("networks/onnx", key, make, bytes, bytes, (), _KEPT)


def input_names(card: ModelCard) -> list[str]:
    """Names of a network's inputs in ONNX, in order."""
    arch = card.settings.arch
    return ["displacement", "mask", *["confidence"] * arch.confidence, *["membrane"] * arch.membrane]


class Predictor:
    """A trained model for pictures of any size and scale."""

    def __init__(self, card: ModelCard, network: bytes, threads: int = 1) -> None:
        """`network`: in ONNX, as of `learn.inference.convert`. UserError: it is none, or of another card."""
        self.card, self.grid = card, card.settings.grid
        self._network = onnx_network.open_network(network, "network.onnx", threads)
        if [node.name for node in self._network.get_inputs()] != input_names(card):
            raise UserError("network.onnx: its inputs are not those of config.json")
        self._view: GridView | None = None

    def check_source(self, source: str) -> str:
        """The source of displacement as given. Raises UserError if this model can't use it."""
        fit = [name for name in FIELDS if has_depth(name) == self.card.settings.arch.depth]
        if source not in fit:
            problem = "this model can't use" if source in FIELDS else "unknown"
            raise UserError(f"{problem} input {source!r}: one of {', '.join(fit)}")
        return source

    def choose_source(self, source: str | None) -> str:
        """The source to read from a store; the recovered one if none is given. Raises as `check_source`."""
        return self.check_source(source or ("motion" if self.card.settings.arch.depth else "recovered"))

    @checked
    def __call__(
        self,
        flow: Map,
        tissue: Mask,
        scale_mm_per_px: float,
        young_kpa: float | None = None,
        confidence: Map | None = None,
        moved: Motion3D | None = None,
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
        batch_confidence = None if cell_confidence is None else cell_confidence[None]
        density = self.density(displacement[None], view.mask, young, batch_confidence, membrane)
        motion = None
        if self.card.intervals is not None:
            motion = motion_features(displacement[None], view.mask, batch_confidence, self.grid.extent_mm)[0]
        return ForceMap(density[0], self.grid, young, young_kpa is not None, view, motion)

    def on_grid(
        self, view: GridView, flow: Map, confidence: Map | None = None, moved: Motion3D | None = None
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
            raise UserError(
                "this model needs motion in three dimensions: give right and calibration, or a recording "
                "with a right or depth camera"
            )
        for label, values in (("motion", moved.motion), ("its deviation", moved.deviation)):
            if values.shape != (height, width, 3):
                raise UserError(f"{label}: expected ({height}, {width}, 3), got {values.shape}")
        return view.mean(moved.motion.transpose(2, 0, 1)), view.mean(certainty(moved.deviation))

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
        n, settings = self.grid.size, self.card.settings
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
            shift = np.asarray(displacement[frames], np.float32)
            inside = np.broadcast_to(np.asarray(mask, np.float32), (len(shift), 1, n, n))
            inputs = {"displacement": shift, "mask": np.ascontiguousarray(inside)}
            if settings.arch.confidence:
                full_confidence = np.ones((len(shift), parts - 1, n, n), np.float32)
                inputs["confidence"] = (
                    full_confidence if confidence is None else np.asarray(confidence[frames], np.float32)
                )
            if settings.arch.membrane:
                inputs["membrane"] = np.full(len(shift), membrane_code(membrane), np.float32)
            with as_user_error("the network"):
                (output,) = self._network.run(["density"], inputs)
            maps.append(_check_shape(output, (len(shift), settings.arch.components, n, n)))
        with np.errstate(over="ignore", invalid="ignore"):  # checked below
            density = np.concatenate(maps) * np.float32(self.card.force_gain * young_kpa)
        if not np.isfinite(density).all():
            raise UserError("the model predicts NaN or infinity: its weights or scales are invalid")
        return density


def _check_shape(output: Array, shape: tuple[int, ...]) -> Map:
    """A network's output. UserError if it is of another shape."""
    if output.shape != shape:
        raise UserError(f"network.onnx: its output is {output.shape}, expected {shape}")
    return np.asarray(output, np.float32)


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
    is_scalar = density.shape[-3] == 1
    return density.squeeze(-3) if is_scalar else np.asarray(np.sqrt(np.square(density).sum(-3)))


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
