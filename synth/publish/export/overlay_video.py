"""Films of sequences with what is known drawn over them: force, flow, and the force's curve."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as Several
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.publish import film
from synth.publish.picture import Rgb, arrow_gain, arrows
from synth.publish.preview_video import encode_video

OVERLAYS = {"flow": "flow", "recovered": "flow_recovered", "force": "traction"}
"""What can be drawn, and the field that it is of."""

_QUALITY = 18


def write_films(
    dataset: Dataset,
    target: Path,
    overlays: Several[str] = ("flow", "force"),
    interval_s: tuple[float, float] | None = None,
) -> None:
    """`NNNNNN.mp4` a sequence.

    Args:
        dataset: the sequences.
        target: the folder.
        overlays: of `OVERLAYS`; none: the film as it is.
        interval_s: first and last time [s]; all if not given.

    Raises:
        UserError: no such overlay, no frame in that time, or a field that a sequence lacks.
    """
    unknown = [name for name in overlays if name not in OVERLAYS]
    if unknown:
        raise UserError(f"{unknown[0]}: is not one of {', '.join(OVERLAYS)}")
    for sequence in dataset:
        drawn = draw_film(sequence, overlays, interval_s)
        file = target / f"{sequence.index:06d}.mp4"
        encode_video(file, drawn, float(sequence.attrs["fps"]), quality=_QUALITY)


def draw_film(
    sequence: Sequence, overlays: Several[str], interval_s: tuple[float, float] | None = None
) -> Iterator[Rgb]:
    """The frames of that time, (h, W, 3) each; with `force` its curve is below. Raises as above."""
    for name in overlays:
        if OVERLAYS[name] not in sequence:
            raise UserError(f"{sequence.path}: holds no {OVERLAYS[name]}")
    time = sequence["time"][:]
    first, last = interval_s or (-np.inf, np.inf)
    chosen = [int(t) for t in np.flatnonzero((time >= first) & (time <= last))]
    if not chosen:
        raise UserError(f"{sequence.path}: has no frame between {first:g} and {last:g} s")
    return _drawn(sequence, overlays, chosen)


def _drawn(sequence: Sequence, overlays: Several[str], chosen: list[int]) -> Iterator[Rgb]:
    tissue, size = sequence["tissue"][:], np.linalg.norm(sequence["force"][:], axis=1)
    largest = {
        name: max(float(np.linalg.norm(sequence[OVERLAYS[name]][t], axis=-1).max()) for t in chosen)
        for name in overlays
    }
    for k, t in enumerate(chosen):
        if not overlays:
            yield sequence["rgb"][t]
            continue
        picture = _frame(sequence, t, tissue, largest)
        if "force" in overlays:
            curve = film.draw_curve(sequence["time"][:][chosen], size[chosen], picture.shape[1], "mN")
            picture = np.vstack([picture, film.mark(curve, k, len(chosen))])
        yield picture


def _frame(sequence: Sequence, t: int, tissue: NDArray[np.bool_], largest: dict[str, float]) -> Rgb:
    picture, said = sequence["rgb"][t], [f"{sequence['time'][t]:.2f} s"]
    if "force" in largest:
        size = np.linalg.norm(sequence["traction"][t], axis=-1)
        moved = film.carried(np.where(tissue, size, 0.0), sequence["flow"][t])
        picture = film.glow(picture, moved, largest["force"])
        said.append(f"{np.linalg.norm(sequence['force'][t]):.1f} mN (yellow: {largest['force']:.2g} kPa)")
    for name in (name for name in largest if name != "force"):
        gain = arrow_gain(sequence.size[1], largest[name])
        step_px = max(sequence.size[1] // 24, 8)
        picture = arrows(picture, sequence[OVERLAYS[name]][t], tissue, step_px, gain)
        said.append(f"{OVERLAYS[name]} x{gain}")
    return film.caption(film.legible(picture), "  ".join(said))
