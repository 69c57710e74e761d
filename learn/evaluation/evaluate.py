"""How right a model is on sequences it has never seen: in mN, sequence by sequence, for three states of E."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from learn.checkpoint import SEEN, ModelCard
from learn.data.clips import Clip, amount, target
from learn.data.grid import Grid
from learn.evaluation.metrics import Moments, agreement, contact_mm, ghost_share, line
from learn.evaluation.statistics import Interval, Paired, interval, paired, pooled_r2
from learn.inference.predict import Predictor, force_size, length, total_force
from synth.errors import UserError
from synth.system.terminal import ProgressCallback

GHOST_MN = 5.0
"""A ghost is where a contact-sized patch would seem to carry more than this [mN]."""
PATCH_MM2 = math.pi * 4.0**2
"""Area of that patch: a contact of the jobs' mean radius, 4 mm."""
FREE = 0.01
"""Contact-free is where the true density is under this share of the training data's 99.9th percentile."""
RIM_MM = 2.0
"""Width of the rim around a contact that `ghost_far` leaves out."""
LOW = 0.05
"""A frame is of low force, and an answer above this is a ghost by the relative rule, at this share."""
YOUNG = ("known", "half", "double", "unknown")
"""Columns: E as it is, taken ×½, taken ×2, and not known at all (the training data's typical value). A
further
column, `press`, is there where E was estimated from a calibration press (`learn.inference.stiffness`)."""


@dataclass(frozen=True)
class ClipScore:
    """One sequence's numbers. Forces in mN, densities in mN/mm² (intensity in mN), lengths in mm."""

    name: str
    young_kpa: float
    map: Moments
    """Over tissue cells of all frames, of the density's length."""
    vector: Moments | None
    """Over tissue cells and components, for a model that gives direction."""
    true_mn: NDArray[np.float64]
    """(T,) size of the total force; for a map of lengths the sum of lengths (`learn.data.clips.amount`)."""
    said_mn: NDArray[np.float64]
    vector_error_mn: NDArray[np.float64] | None
    """(T,) length of the total force's error."""
    ghost: float
    """Share of the contact-free area where a contact-sized patch would carry over 5 mN."""
    ghost_relative: float
    """Share of the contact-free area above 5% of the training data's 99.9th percentile."""
    ghost_far: float
    """The same beyond 2 mm of any contact: without the rim, where a contact found a cell aside shows up
    too."""
    stray_mn: float
    """Force the answer puts on the contact-free area, mean over frames [mN]."""
    localisation_mm: float
    """Median distance between true and said centre of the contact, over frames that aren't low [mm]."""
    low_over_mn: float
    """Mean over-prediction of the total force in low-force frames [mN]."""


def score(clip: Clip, said: NDArray[np.float32], card: ModelCard) -> ClipScore:
    """Scores the answer to one sequence. `said`: (T, C, N, N), physical."""
    grid, kind, parts = card.settings.grid, card.settings.target, said.shape[1]
    young = clip.young_kpa
    true = np.stack([target(clip, t, kind, parts) for t in range(clip.frames)]) * np.float32(young)
    inside = np.broadcast_to(np.asarray(clip.mask) > 0, (clip.frames, *clip.mask.shape))
    said_len, true_len = length(said), length(true)
    unit = card.scales.target * young
    free = inside & (true_len < FREE * unit)
    total = total_force(said, kind, grid)
    whole = amount(clip, kind, parts, grid.pitch_mm) * young
    true_mn: NDArray[np.float64] = np.linalg.norm(whole, axis=1)
    low = true_mn < LOW * card.scales.force * young
    as_force = 1.0 if kind == "intensity" else PATCH_MM2
    vector, vector_error = None, None
    if parts == 3:
        components = np.broadcast_to(inside[:, None], said.shape)
        vector = Moments.of(true[components], said[components])
        vector_error = np.linalg.norm(total - clip.force, axis=1)
    distance = [
        float(np.linalg.norm(contact_mm(said_len[t], grid.pitch_mm) - contact_mm(true_len[t], grid.pitch_mm)))
        for t in np.flatnonzero(~low)
    ]
    distance = [d for d in distance if math.isfinite(d)]
    return ClipScore(
        name=clip.name,
        young_kpa=young,
        map=Moments.of(true_len[inside], said_len[inside]),
        vector=vector,
        true_mn=true_mn,
        said_mn=force_size(total),
        vector_error_mn=vector_error,
        ghost=ghost_share(said_len * as_force, free, GHOST_MN),
        ghost_relative=ghost_share(said_len, free, LOW * unit),
        ghost_far=ghost_share(said_len, inside & _away(true_len >= FREE * unit, grid), LOW * unit),
        stray_mn=float((said_len * free).sum((1, 2)).mean() * _cell(kind, grid)),
        localisation_mm=float(np.median(distance)) if distance else math.nan,
        low_over_mn=float(np.maximum(force_size(total) - true_mn, 0)[low].mean()) if low.any() else math.nan,
    )


def _away(contact: NDArray[np.bool_], grid: Grid) -> NDArray[np.bool_]:
    """(T, N, N) beyond `RIM_MM` of any contact in the same frame."""
    out = np.ones_like(contact)
    for t in np.flatnonzero(contact.any((1, 2))):
        out[t] = ndimage.distance_transform_edt(~contact[t]) * grid.pitch_mm > RIM_MM
    return out


def _cell(kind: str, grid: Grid) -> float:
    return grid.pitch_mm**2 if kind == "density" else 1.0 / grid.size**2


@dataclass(frozen=True)
class EvaluationReport:
    """A model's scores over sequences, once for every state of knowledge of E."""

    columns: dict[str, list[ClipScore]]
    card: ModelCard

    @property
    def clips(self) -> list[ClipScore]:
        """With E known."""
        return self.columns["known"]

    def per_clip(self, young: str = "known") -> list[dict[str, float]]:
        """One row a sequence, plain numbers."""
        if young not in self.columns:
            raise UserError(f"unknown E column {young!r}: one of {', '.join(self.columns)}")
        return [_row(c) for c in self.columns[young]]

    def summary(self, young: str = "known") -> dict[str, float]:
        """Mean over sequences of every per-sequence number, and pooled R² (`*_pooled`), in one E column."""
        rows, clips = self.per_clip(young), self.columns[young]
        out = {k: _mean([r[k] for r in rows]) for k in rows[0]}
        out["map_r2_pooled"] = agreement(sum((c.map for c in clips), Moments())).r2
        out["unit_map_r2_pooled"] = agreement(sum((c.map.over(c.young_kpa) for c in clips), Moments())).r2
        true = np.concatenate([c.true_mn for c in clips])
        said = np.concatenate([c.said_mn for c in clips])
        out["force_r2_pooled"] = agreement(Moments.of(true, said)).r2
        out["calibration_slope"], out["calibration_offset_mn"] = line(said, true)
        return out

    def intervals(self) -> dict[str, Interval]:
        """Mean and BCa interval over sequences of every per-sequence number, and of the pooled R²."""
        rows, rng = self.per_clip(), np.random.default_rng(0)
        out = {k: interval(np.array([r[k] for r in rows]), rng) for k in rows[0]}
        out["map_r2_pooled"] = pooled_r2(_sums(c.map for c in self.clips), rng)
        forces = (Moments.of(c.true_mn, c.said_mn) for c in self.clips)
        return out | {"force_r2_pooled": pooled_r2(_sums(forces), rng)}

    def bands(self) -> list[dict[str, float]]:
        """Errors of the total force in four bands of true force, as shares of the training data's largest."""
        edges = [0.0, LOW, 1 / 3, 2 / 3, math.inf]
        share = np.concatenate([c.true_mn / (self.card.scales.force * c.young_kpa) for c in self.clips])
        true = np.concatenate([c.true_mn for c in self.clips])
        said = np.concatenate([c.said_mn for c in self.clips])
        out = []
        for a, b in itertools.pairwise(edges):
            here = (share >= a) & (share < b)
            gap = said[here] - true[here]
            out.append(
                {
                    "from": a,
                    "to": b if math.isfinite(b) else float(share.max(initial=a)),
                    "frames": float(here.sum()),
                    "mae_mn": float(np.abs(gap).mean()) if here.any() else math.nan,
                    "bias_mn": float(gap.mean()) if here.any() else math.nan,
                }
            )
        return out

    def as_dict(self) -> dict[str, object]:
        """JSON-ready; NaN as null."""
        return {
            "sequences": [
                {
                    "name": c.name,
                    "young_kpa": c.young_kpa,
                    **_plain(_row(c)),
                    "map_moments": list(astuple(c.map)),
                }
                for c in self.clips
            ],
            "columns": {young: _plain(self.summary(young)) for young in self.columns},
            "intervals": {k: _plain({"low": i.low, "high": i.high}) for k, i in self.intervals().items()},
            "bands": [_plain(b) for b in self.bands()],
            "scales": asdict(self.card.scales),
            "definitions": {
                "ghost_mn": GHOST_MN,
                "patch_mm2": PATCH_MM2,
                "free_share": FREE,
                "rim_mm": RIM_MM,
                "low_share": LOW,
                "target": self.card.settings.target,
            },
        }


def _row(c: ClipScore) -> dict[str, float]:
    row = {f"map_{k}": v for k, v in asdict(agreement(c.map)).items()}
    row |= {f"force_{k}": v for k, v in asdict(agreement(Moments.of(c.true_mn, c.said_mn))).items()}
    if c.vector is not None:
        row["vector_r2"] = agreement(c.vector).r2
    if c.vector_error_mn is not None:
        row["vector_error_mn"] = float(c.vector_error_mn.mean())
    peak = float(c.true_mn.max())
    row["peak_error_share"] = abs(float(c.said_mn.max()) - peak) / peak if peak > 0 else math.nan
    for name in ("ghost", "ghost_relative", "ghost_far", "stray_mn", "localisation_mm", "low_over_mn"):
        row[name] = getattr(c, name)
    return row


def _sums(moments: Iterable[Moments]) -> NDArray[np.float64]:
    return np.array([astuple(m)[:6] for m in moments])


def _mean(values: Sequence[float]) -> float:
    good = [v for v in values if math.isfinite(v)]
    return float(np.mean(good)) if good else math.nan


def _plain(row: dict[str, float]) -> dict[str, Any]:
    return {k: v if math.isfinite(v) else None for k, v in row.items()}


def evaluate(
    predictor: Predictor,
    clips: Sequence[Clip],
    source: str,
    report: ProgressCallback = lambda done, of: None,
    pressed: Mapping[str, float] | None = None,
) -> EvaluationReport:
    """Scores a model on clips, with displacement from `source` (`ideal` or `recovered`).

    `pressed`: E [kPa] of clips by their content hash, as a calibration press found it: the column `press`
    holds those that have one.
    """
    if not clips:
        raise UserError("no sequence to evaluate on")
    columns: dict[str, list[ClipScore]] = {}
    for i, clip in enumerate(clips):
        report(i, len(clips))
        if source not in clip.displacement:
            raise UserError(f"{clip.name}: holds no {source} flow")
        taken = {"known": 1.0, "half": 0.5, "double": 2.0}
        young = {name: clip.young_kpa * factor for name, factor in taken.items()}
        young["unknown"] = predictor.card.typical_young_kpa
        if pressed is not None and clip.content_hash in pressed:
            young["press"] = pressed[clip.content_hash]
        # The answer is proportional to E: one pass does for all.
        said = predictor.density(np.asarray(clip.displacement[source]), clip.mask, 1.0, clip.sure(source))
        for name, given in young.items():
            columns.setdefault(name, []).append(score(clip, said * np.float32(given), predictor.card))
    report(len(clips), len(clips))
    return EvaluationReport(columns, predictor.card)


def compare(a: EvaluationReport, b: EvaluationReport) -> dict[str, Paired]:
    """B against A on the same sequences, number by number; numbers that no sequence has from both are left
    out."""
    rows, rng = (a.per_clip(), b.per_clip()), np.random.default_rng(0)
    if [c.name for c in a.clips] != [c.name for c in b.clips]:
        raise UserError("paired test: the two models were not scored on the same sequences")
    out = {}
    for key in rows[0][0]:
        one, two = (np.array([row.get(key, math.nan) for row in side]) for side in rows)
        if np.isfinite(two - one).any():
            out[key] = paired(one, two, rng)
    return out


def unseen(clips: Sequence[Clip], card: ModelCard) -> list[Clip]:
    """Clips of no sequence and no anatomy that the model was fitted or chosen on, or its intervals fitted."""
    hashes = {h for part in SEEN for h in card.split.get(part, [])}
    seen = {g for part in SEEN for g in card.groups.get(part, [])}
    return [c for c in clips if c.content_hash not in hashes and c.group not in seen]
