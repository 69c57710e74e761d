"""Videos not made by this project's renderer, tracked as by `bench score`: masks, lost frames and error."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from evidence import report
from evidence.flow.measure import epe
from evidence.flow.scenes import Frame, Recipe, recipes, video
from evidence.study import Study
from synth.arrays import Array, Mask
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.video_pass import VideoPass
from synth.video.read_video import Picture

_MASKS = ("auto", "none")
_CORRUPTED = ("black", "covered", "defocus", "jump")  # faults whose frames count for the flags alone
_FPS = 10.0
Table = Mapping[str, Array]


def measure(
    half: str = "reporting", count: int = 48, first: int = 48, size: int = 160, frames: int = 14
) -> dict[str, Any]:
    """Errors on `count` videos of a half after its `first` ones; settings were tuned on the half `tuning`."""
    rows = [judge(one, size, frames) for one in recipes(half, count, first)]
    return {"half": half, "summary": summarise(rows)}


def judge(recipe: Recipe, size: int, frames: int) -> dict[str, Any]:
    """Errors of one video.

    Returns:
        `auto`, `none`: mean endpoint error with detected masks and without over frames that show the tissue
        [px]; `covered`: share of unobstructed tissue masked; numbers of frames that are `lost` (error above
        1 px and above that of zero flow, or less than a fifth of the tissue visible), `flagged`, and both
        (`hits`).
    """
    shown = list(video(recipe, size, frames))
    ways = {name: _follow(shown, name) for name in _MASKS}
    later, (error, trusted, covered) = shown[1:], ways["auto"]
    good = np.array([one.fault not in _CORRUPTED for one in later])
    motion = np.array([_mean(np.linalg.norm(one.flow, axis=-1), one.visible) for one in later])
    tissue = np.count_nonzero(shown[0].visible)
    shows = np.array([one.fault != "black" and one.visible.sum() > 0.2 * tissue for one in later])
    lost = ~shows | ((error > 1) & (error > motion))
    return {
        "covered": float(np.nanmean(covered)),
        **{name: float(np.nanmean(way[0][good])) for name, way in ways.items()},
        "lost": int(lost.sum()),
        "flagged": int((~trusted).sum()),
        "hits": int((lost & ~trusted).sum()),
    }


def _follow(shown: Sequence[Frame], masks: str) -> tuple[Array, ...]:
    """Tracking of a video as by `bench score`, with tissue all over the image.

    Returns:
        Mean endpoint error over visible tissue [px], whether flow is trusted, share of unobstructed tissue
        that is masked; (T - 1,) each, NaN without such tissue.
    """
    pictures = [Picture(k, k / _FPS, one.rgb) for k, one in enumerate(shown)]
    flow = VideoPass(Footage(lambda: pictures, "video"), RecordingFlowSettings(rate_hz=None, masks=masks))
    rows = []
    for one, found in zip(shown, flow.frames(), strict=True):
        if not found.is_rest:
            error = _mean(epe(found.flow, one.flow), one.visible)
            rows.append((error, found.trusted, _mean(1.0 * found.hidden, one.free)))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def _mean(field: Array, where: Mask) -> float:
    return float(field[where].mean()) if where.any() else float("nan")


def _ratio(part: Array, whole: Array) -> float:
    return float(part.sum() / max(1, whole.sum()))


_FIGURES: dict[str, tuple[str, Callable[[Table], float]]] = {
    "videos with at most 3% of unobstructed tissue masked": (
        "≥ 0.95",
        lambda t: float((t["covered"] <= 0.03).mean()),
    ),
    "largest share of unobstructed tissue masked": ("≤ 0.2", lambda t: float(t["covered"].max())),
    "EPE / that without masks": ("≤ 1.05", lambda t: float(t["auto"].mean() / t["none"].mean())),
    "frames lost: precision": ("≥ 0.8", lambda t: _ratio(t["hits"], t["flagged"])),
    "frames lost: recall": ("≥ 0.9", lambda t: _ratio(t["hits"], t["lost"])),
    "EPE mean, detected masks [px]": ("", lambda t: float(t["auto"].mean())),
    "EPE mean, no masks [px]": ("", lambda t: float(t["none"].mean())),
}


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Every figure with its 95% bootstrap interval over videos."""
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, len(rows), len(rows)) for _ in range(2000)]
    made = []
    for name, (target, figure) in _FIGURES.items():
        spread = [figure({key: values[draw] for key, values in table.items()}) for draw in draws]
        low, high = np.percentile(spread, [2.5, 97.5]).tolist()
        made.append({"what": name, "target": target, "measured": figure(table), "low": low, "high": high})
    return made


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `recordings.json`."""
    limited = [row for row in found["summary"] if row["target"]]
    rows = {row["what"]: (row["measured"], row["low"], row["high"]) for row in limited}
    chart = report.intervals(f"{found['half']} half, 95% intervals over videos", "measured", rows)
    words = ["Photographs and drawn phantoms, warped in closed form, none of them tuned on."]
    sections = [report.Section("", found["summary"])]
    return report.Page("Flow: videos not made by our renderer", found, words, sections, chart)


STUDY = Study(measure, "flow/recordings/recordings.json", page, needs=("flow", "score"))
