"""Films that no renderer of ours made, followed as `bench score` does: masks, trust and error.

Run: python -m evidence.flow.foreign
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import typer
from numpy.typing import NDArray

from evidence import report
from evidence.flow.foreign_scenes import Recipe, Shown, film, recipes
from evidence.flow.measure import epe
from synth.recording_flow.video_flow import Footage, RecordingFlowSettings, VideoFlow
from synth.video.read import Picture

_MASKS = ("auto", "both", "none")  # chosen, all that are found, none
_SPOILT = ("black", "covered", "defocus", "jump")  # mishaps whose frames count for the flag alone
_FPS = 10.0
Table = Mapping[str, NDArray[Any]]


def main(
    out: Path = report.RESULTS / "flow/recordings",
    half: str = "reporting",
    count: int = 48,
    first: int = 48,
    size: int = 160,
    frames: int = 14,
    jobs: int = 2,
) -> None:
    """`count` films of a half after its `first` ones; settings were chosen on the half `tuning`."""
    chosen = recipes(half, count, first)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(partial(judge, size=size, frames=frames), chosen))
    found = {"half": half, "summary": summarise(rows)}
    report.save(out, "recordings.json", found, page(found))
    report.show(found)


def judge(recipe: Recipe, size: int, frames: int) -> dict[str, Any]:
    """One film against its truth.

    Returns:
        `auto`, `both`, `none`: mean endpoint error with these masks over frames that show the tissue
        [px]; `covered`: share of free tissue masked; numbers of frames that are lost (off by over 1 px and by
        more than if nothing moved, or showing less than a fifth of the tissue), flagged, and both.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    shown = list(film(recipe, size, frames))
    ways = {name: _follow(shown, name) for name in _MASKS}
    later, (error, trusted, covered) = shown[1:], ways["auto"]
    good = np.array([one.mishap not in _SPOILT for one in later])
    motion = np.array([_mean(np.linalg.norm(one.flow, axis=-1), one.seen) for one in later])
    tissue = np.count_nonzero(shown[0].seen)
    shows = np.array([one.mishap != "black" and one.seen.sum() > 0.2 * tissue for one in later])
    lost = ~shows | ((error > 1) & (error > motion))
    return {
        "covered": float(np.nanmean(covered)),
        **{name: float(np.nanmean(way[0][good])) for name, way in ways.items()},
        "lost": int(lost.sum()),
        "flagged": int((~trusted).sum()),
        "hits": int((lost & ~trusted).sum()),
    }


def _follow(shown: Sequence[Shown], masks: str) -> tuple[NDArray[Any], ...]:
    """A film as `bench score` follows it, all of the picture being tissue.

    Returns:
        Mean endpoint error over seen tissue [px], whether flow is trusted, share of free tissue masked;
        (T - 1,) each, NaN where there is no such tissue.
    """
    pictures = (Picture(k, k / _FPS, one.rgb) for k, one in enumerate(shown))
    video = VideoFlow(Footage(pictures, "film"), RecordingFlowSettings(rate_hz=None, masks=masks))
    rows = []
    for one, found in zip(shown, video.frames(), strict=True):
        if not found.is_rest:
            blocked = np.zeros_like(one.free) if found.masked is None else found.masked
            error, covered = _mean(epe(found.flow, one.flow), one.seen), _mean(1.0 * blocked, one.free)
            rows.append((error, found.trusted, covered))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def _mean(field: NDArray[Any], where: NDArray[np.bool_]) -> float:
    return float(field[where].mean()) if where.any() else float("nan")


def _ratio(part: NDArray[Any], whole: NDArray[Any]) -> float:
    return float(part.sum() / max(1, whole.sum()))


def _behind(t: Table) -> NDArray[Any]:
    """The better of all masks and none."""
    return np.minimum(t["both"], t["none"])


_FIGURES: dict[str, tuple[str, Callable[[Table], float]]] = {
    "films with at most 3% of free tissue masked": ("≥ 0.95", lambda t: float((t["covered"] <= 0.03).mean())),
    "largest share of free tissue masked": ("≤ 0.2", lambda t: float(t["covered"].max())),
    "EPE / better of all masks and none": ("≤ 1.05", lambda t: float(t["auto"].mean() / _behind(t).mean())),
    "frames lost: precision": ("≥ 0.8", lambda t: _ratio(t["hits"], t["flagged"])),
    "frames lost: recall": ("≥ 0.9", lambda t: _ratio(t["hits"], t["lost"])),
    "EPE mean, chosen masks [px]": ("", lambda t: float(t["auto"].mean())),
    "EPE mean, all masks that are found [px]": ("", lambda t: float(t["both"].mean())),
    "EPE mean, no masks [px]": ("", lambda t: float(t["none"].mean())),
}


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Every figure with its 95% interval, films being drawn with replacement."""
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, len(rows), len(rows)) for _ in range(2000)]
    made = []
    for name, (asked, figure) in _FIGURES.items():
        spread = [figure({key: values[draw] for key, values in table.items()}) for draw in draws]
        low, high = np.percentile(spread, [2.5, 97.5]).tolist()
        made.append({"what": name, "asked": asked, "found": figure(table), "low": low, "high": high})
    return made


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `recordings.json`."""
    asked = [row for row in found["summary"] if row["asked"]]
    rows = tuple(report.Row(row["what"], row["found"], (row["low"], row["high"])) for row in asked)
    charts = [report.Chart(f"Unseen films ({found['half']} half), 95% over films", "found", rows)]
    sections = [report.Section("Asked against found", found["summary"])]
    return report.Page("Flow: films from elsewhere", found, charts, sections)


if __name__ == "__main__":
    typer.run(main)
