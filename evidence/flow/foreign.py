"""`bench stability recordings`: films that no renderer of ours made, followed as `bench score` does."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import torch
import typer
from numpy.typing import NDArray

from bench.output import charts, result_page
from evidence.flow import foreign_pairs
from evidence.flow.foreign_scenes import Recipe, Shown, film, recipes
from evidence.flow.measure import epe
from evidence.measuring import measuring
from learn.inference.video import Picture
from learn.inference.video_flow import Footage, Settings, VideoFlow

_cv2: Any = cv2  # its type stubs leave out the contributed modules
_WAYS = ("auto", "both", "none")
"""Masks of which each recording is followed with."""
_SPOILT = ("black", "covered", "defocus", "jump")
"""Mishaps whose frames count for the flag alone."""
_FPS = 10.0


@dataclass(frozen=True)
class Followed:
    """One recording followed in one way; (T - 1,) without the rest frame."""

    error: NDArray[np.float64]
    """Mean endpoint error over the tissue that is seen [px]; NaN where none is."""
    size: NDArray[np.float64]
    """Mean length of the flow over the picture [px]."""
    trusted: NDArray[np.bool_]
    covered: NDArray[np.float64]
    """Share that was masked of the tissue that is free of tool and glare; NaN where none is."""
    cpu_s: float
    """Of all that is done ..."""
    mask_s: float
    """... and of finding masks."""


@dataclass(frozen=True)
class Row:
    """One recording. Errors in px, means over frames that show it."""

    scene: int
    surface: str
    tool: str
    motion: str
    covered: float
    """Share of free tissue that the masks took."""
    auto: float
    """EPE with chosen masks ..."""
    both: float
    """... with all that are found ..."""
    none: float
    """... and with none."""
    r: float
    """Correlation of the mean flow's length with the true amplitude, of frames that are trusted."""
    r_dis: float
    """The same of OpenCV's DIS on the plain pictures, all frames that show the tissue."""
    lost: int
    """Frames off by over 1 px and a fifth of the motion, or that show less than a fifth of the tissue."""
    flagged: int
    hits: int
    """Frames that are both."""


@measuring(
    "--out runs/recordings --half tuning --count 4",
    out=...,
    said="Folder for recordings.json, chart.svg, index.html.",
    file="recordings.json",
    page=lambda found, out: result_page.write(drawn(found), out),
)
def recordings(
    half: Annotated[
        Literal["tuning", "reporting"], typer.Option(help="Settings were chosen on `tuning`.")
    ] = "reporting",
    count: Annotated[int, typer.Option(min=2, help="Recordings.")] = 48,
    first: Annotated[int, typer.Option(min=0, help="How many of the half are passed over.")] = 0,
    size: Annotated[int, typer.Option(min=64, help="Width and height of the pictures [px].")] = 160,
    frames: Annotated[int, typer.Option(min=6, help="Frames of each.")] = 14,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    pairs: Annotated[int, typer.Option(min=0, help="Pairs of speckle, layers and a street's pan.")] = 6,
    long: Annotated[int, typer.Option(help="Frames of the recordings that are timed; 0: none.")] = 150,
) -> dict[str, Any]:
    """Flow: masks, trust and error on recordings of known motion that no renderer of ours made."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(partial(_judged, size=size, frames=frames), recipes(half, count, first=first)):
            rows.append(row)
            typer.echo(_line(row), err=True)
    found: dict[str, Any] = {"half": half, "summary": summarise(rows)}
    if pairs:
        found["pairs"] = foreign_pairs.rows(pairs, 2711 if half == "reporting" else 11)
    if long:
        found["time"] = _times(recipes(half, 2, first=first), size, long)
    worst = [asdict(row) for row in sorted(rows, key=_badness)[-6:]]
    return found | {
        "worst": [{k: round(v, 4) if isinstance(v, float) else v for k, v in one.items()} for one in worst]
    }


def _judged(recipe: Recipe, size: int, frames: int) -> Row:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    return judge(recipe, list(film(recipe, size, frames)))


def _line(row: Row) -> str:
    errors = f"EPE {row.auto:.2f} (both {row.both:.2f}, none {row.none:.2f})"
    return f"{row.scene:3} {row.surface:22} {row.tool:14} {errors}, r {row.r:.3f}, masked {row.covered:.3f}"


def _badness(row: Row) -> float:
    return row.auto / min(row.both, row.none)


def follow(shown: Sequence[Shown], masks: str) -> Followed:
    """A recording as `bench score` follows it, all of the picture being tissue."""
    pictures = (Picture(k, k / _FPS, one.rgb) for k, one in enumerate(shown))
    video = VideoFlow(Footage(pictures, "film"), Settings(rate_hz=None, masks=masks))
    errors, sizes, trusted, covered = [], [], [], []
    began = time.process_time()
    for one, step in zip(shown, video.steps(), strict=True):
        found = step.found
        if found.is_rest:
            continue
        errors.append(_mean(epe(found.flow, one.flow), one.seen))
        sizes.append(float(np.linalg.norm(found.flow, axis=-1).mean()))
        trusted.append(found.trusted)
        blocked = np.zeros_like(one.free) if found.blocked is None else found.blocked
        covered.append(_mean(blocked.astype(np.float32), one.free))
    spent, mask = time.process_time() - began, video.watch.report()["mask"]
    assert isinstance(mask, dict)
    return Followed(
        np.array(errors), np.array(sizes), np.array(trusted), np.array(covered), spent, mask["cpu_s"]
    )


def _dis(shown: Sequence[Shown]) -> NDArray[np.float64]:
    """Mean length of the flow [px] of OpenCV's DIS, medium, rest frame to now, without masks."""
    solver = _cv2.DISOpticalFlow_create(_cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(one.rgb, cv2.COLOR_RGB2GRAY) for one in shown]
    blank: Any = None
    flows = [solver.calc(grey[0], now, blank) for now in grey[1:]]
    return np.array([float(np.linalg.norm(flow, axis=-1).mean()) for flow in flows])


def judge(recipe: Recipe, shown: Sequence[Shown]) -> Row:
    """One recording against its truth."""
    ways = {name: follow(shown, name) for name in _WAYS}
    auto, later = ways["auto"], shown[1:]
    good = np.array([one.mishap not in _SPOILT for one in later])
    amplitude = np.array([one.amplitude for one in later])
    motion = np.array([_mean(np.linalg.norm(one.flow, axis=-1), one.seen) for one in later])
    tissue = np.count_nonzero(shown[0].seen)
    shows = np.array([one.mishap != "black" and one.seen.sum() > 0.2 * tissue for one in later])
    lost = ~shows | ((auto.error > 1) & (auto.error > 0.2 * motion))
    return Row(
        recipe.index,
        recipe.surface,
        recipe.tool,
        recipe.motion,
        covered=float(np.nanmean(auto.covered)),
        **{name: float(np.nanmean(way.error[good])) for name, way in ways.items()},
        r=_correlation(auto.size[good & auto.trusted], amplitude[good & auto.trusted]),
        r_dis=_correlation(_dis(shown)[good], amplitude[good]),
        lost=int(lost.sum()),
        flagged=int((~auto.trusted).sum()),
        hits=int((lost & ~auto.trusted).sum()),
    )


def _mean(field: NDArray[Any], where: NDArray[np.bool_]) -> float:
    return float(field[where].mean()) if where.any() else float("nan")


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """0 of what doesn't change."""
    return float(np.corrcoef(a, b)[0, 1]) if len(a) > 2 and a.std() > 0 and b.std() > 0 else 0.0


Figure = Callable[[Mapping[str, NDArray[Any]]], float]

_FIGURES: dict[str, tuple[str, Figure]] = {
    "scenes with at most 3% of free tissue masked": (
        "≥ 0.95",
        lambda t: float(np.mean(t["covered"] <= 0.03)),
    ),
    "largest share of free tissue masked": ("≤ 0.2", lambda t: float(t["covered"].max())),
    "EPE / better of all masks and none, mean over scenes": (
        "≤ 1.05",
        lambda t: float(t["auto"].mean() / np.minimum(t["both"], t["none"]).mean()),
    ),
    "scenes whose own ratio is at most 1.05": (
        "",
        lambda t: float(np.mean(t["auto"] <= 1.05 * np.minimum(t["both"], t["none"]))),
    ),
    "scenes with r ≥ 0.97 of those that DIS follows with r ≥ 0.9": (
        "1",
        lambda t: _ratio((t["r"] >= 0.97) & (t["r_dis"] >= 0.9), t["r_dis"] >= 0.9),
    ),
    "frames lost: precision": ("≥ 0.8", lambda t: _ratio(t["hits"], t["flagged"])),
    "frames lost: recall": ("≥ 0.9", lambda t: _ratio(t["hits"], t["lost"])),
    "EPE mean, chosen masks [px]": ("", lambda t: float(t["auto"].mean())),
    "EPE mean, all masks that are found [px]": ("", lambda t: float(t["both"].mean())),
    "EPE mean, no masks [px]": ("", lambda t: float(t["none"].mean())),
}


def _ratio(part: NDArray[Any], whole: NDArray[Any]) -> float:
    return float(part.sum() / max(1, whole.sum()))


def summarise(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Every figure with its 95% interval, scenes being drawn with replacement."""
    table = {name: np.array([getattr(row, name) for row in rows]) for name in asdict(rows[0])}
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, len(rows), len(rows)) for _ in range(2000)]
    made = []
    for name, (asked, figure) in _FIGURES.items():
        spread = [figure({key: values[draw] for key, values in table.items()}) for draw in draws]
        low, high = np.percentile(spread, [2.5, 97.5])
        values = {"found": figure(table), "low": float(low), "high": float(high)}
        made.append({"what": name, "asked": asked, **{key: round(v, 4) for key, v in values.items()}})
    return made


def _times(chosen: Sequence[Recipe], size: int, frames: int) -> list[dict[str, Any]]:
    """CPU time with chosen masks against all that are found, in turns."""
    return [_time(replace(recipe, mishaps=()), size, frames) for recipe in chosen]


def _time(recipe: Recipe, size: int, frames: int) -> dict[str, Any]:
    shown = list(film(recipe, size, frames))
    ratios = []
    for _ in range(2):
        chosen, plain = follow(shown, "auto"), follow(shown, "none")
        # Masks were found before they were chosen, too: what choosing costs is what is asked.
        ratios.append(chosen.cpu_s / (plain.cpu_s + chosen.mask_s - plain.mask_s))
    return {"surface": recipe.surface, "frames": frames, "ratio": round(min(ratios), 3)}


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `recordings.json` says."""
    shares = {
        row["what"]: (row["found"], (row["low"], row["high"])) for row in found["summary"] if row["asked"]
    }
    rows = charts.bars(
        {name: value for name, (value, _) in shares.items()},
        {name: ends for name, (_, ends) in shares.items()},
    )
    chart = charts.Chart(f"Unseen recordings ({found['half']} half), 95% over scenes", "found", rows)
    sections = [
        result_page.Section("Asked against found", found["summary"]),
        result_page.Section("Pairs as other fields have them", found.get("pairs", [])),
        result_page.Section("Time with chosen masks / with none", found.get("time", [])),
        result_page.Section("Scenes furthest behind the better of all masks and none", found["worst"]),
    ]
    return result_page.Page("Flow: recordings from elsewhere", found, [chart], sections)
