"""Bad input to learn, tried on the real commands and calls: each must end in one clear line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from learn.data.clips import Clip
from learn.inference.apply import motions
from learn.inference.predict import load_predictor
from learn.settings import Settings
from learn.training.batches import Frames
from synth.errors import UserError


def bad_inputs(model: Path, scratch: Path) -> list[dict[str, Any]]:
    """Every case with the line it got; `one line` is False where it got anything else.

    `model`: a trained model; `scratch`: a folder for broken copies, emptied first.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    predictor = load_predictor(model)
    n = predictor.grid.size
    ones, moved = np.ones((n, n), np.float32), np.zeros((1, 2, n, n), np.float32)

    def broken(name: str, file: str, data: bytes) -> Path:
        to = scratch / name
        to.mkdir()
        for item in (f for f in model.iterdir() if f.is_file()):
            shutil.copy(item, to)
        (to / file).write_bytes(data)
        return to

    def arrays(name: str, **values: Any) -> Path:
        np.savez(scratch / name, **values)
        return scratch / f"{name}.npz"

    card = json.loads((model / "config.json").read_text())
    card["settings"]["arch"]["width"] *= 2
    weights = (model / "weights.pt").read_bytes()
    flow, still = np.zeros((2, 8, 8, 2), np.float32), np.ones((8, 8), bool)
    cases: dict[str, Callable[[], object]] = {
        "another grid": lambda: predictor.density(np.zeros((1, 2, n // 2, n // 2), np.float32), ones, 1.0),
        "channels last": lambda: predictor.density(np.zeros((1, n, n, 2), np.float32), ones, 1.0),
        "three channels": lambda: predictor.density(np.zeros((1, 3, n, n), np.float32), ones, 1.0),
        "NaN in the displacement": lambda: predictor.density(np.full_like(moved, np.nan), ones, 1.0),
        "clips of another grid": lambda: Frames([_blank(n)], Settings(size=2 * n, arch=_arch(predictor))),
        "no tissue in the picture": lambda: predictor(flow[0], ~still, 0.1),
        "scale 0 mm/px": lambda: predictor(flow[0], still, 0.0),
        "E -1 kPa": lambda: predictor(flow[0], still, 0.1, -1.0),
        "no store there": lambda: next(motions(scratch / "none.zarr", "recovered")),
        "flow and tissue differ": lambda: next(
            motions(arrays("a", flow=flow, tissue=np.ones((8, 9)), scale_mm_per_px=0.1), "recovered")
        ),
        "no scale": lambda: next(motions(arrays("b", flow=flow, tissue=still), "recovered")),
        "a video without a scale": lambda: next(motions(scratch / "c.mp4", "recovered")),
        "checkpoint cut short": lambda: load_predictor(
            broken("d", "weights.pt", weights[: len(weights) // 2])
        ),
        "checkpoint of another network": lambda: load_predictor(
            broken("e", "config.json", json.dumps(card).encode())
        ),
        "configuration damaged": lambda: load_predictor(broken("f", "config.json", b"{")),
        "no model there": lambda: load_predictor(scratch / "nothing"),
    }
    return [_try(name, case, scratch) for name, case in cases.items()]


def _try(name: str, case: Callable[[], object], scratch: Path) -> dict[str, Any]:
    try:
        case()
    except UserError as error:
        said = str(error).replace(f"{scratch}/", "")
        return {"case": name, "one line": "\n" not in said, "said": said}
    return {"case": name, "one line": False, "said": "(accepted)"}


def _arch(predictor: Any) -> Any:
    return predictor.card.settings.arch


def _blank(n: int) -> Clip:
    return Clip(
        name="000000.zarr",
        content_hash="x",
        group="x",
        family="",
        gesture="",
        young_kpa=1.0,
        mask=np.ones((n, n), np.float32),
        displacement={"ideal": np.zeros((1, 2, n, n), np.float32)},
        confidence=np.ones((1, n, n), np.float32),
        density=np.zeros((1, 3, n, n), np.float32),
        force=np.zeros((1, 3)),
    )
