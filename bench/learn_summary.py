"""The study's runs as a table that a reader can check: means over sequences, BCa intervals, paired tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bench.learn_runs import column
from learn.statistics import Interval, interval, paired

_COLUMNS = (
    ("map_r2", "map R²"),
    ("map_rmse", "map RMSE [mN/mm²]"),
    ("force_mae", "total force MAE [mN]"),
    ("peak_error_share", "peak force error"),
    ("ghost_relative", "ghost area"),
    ("ghost_far", "ghost area beyond 2 mm"),
    ("stray_mn", "force off contact [mN]"),
    ("low_over_mn", "over in low frames [mN]"),
    ("localisation_mm", "contact centre [mm]"),
)


def runs(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(file.read_text()) for file in sorted(folder.glob("runs/*.json"))]


def family(name: str) -> str:
    """What a run compares: its name without fold and seed."""
    return name.split("-fold")[0]


def write(out: Path) -> None:
    """`out`/README.md from every run found in `out`/*/runs."""
    parts = []
    for folder in sorted(p for p in out.iterdir() if (p / "runs").is_dir()):
        found = runs(folder)
        if found:
            parts += [f"## {folder.name}", "", *_table(found), "", *_tests(found), ""]
    head = (out / "HEAD.md").read_text() if (out / "HEAD.md").is_file() else "# Learn: results\n"
    (out / "README.md").write_text(head + "\n" + "\n".join(parts))


def _table(found: list[dict[str, Any]]) -> list[str]:
    names = sorted({family(r["name"]) for r in found})
    lines = ["| runs | pooled map R² | pooled force R² | " + " | ".join(c for _, c in _COLUMNS) + " |"]
    lines.append("|" + " --- |" * (len(_COLUMNS) + 3))
    for name in names:
        group = [r for r in found if family(r["name"]) == name]
        pooled = [[r["columns"]["known"][k] for r in group] for k in ("map_r2_pooled", "force_r2_pooled")]
        cells = [_text(interval(_per_sequence(group, k), np.random.default_rng(0))) for k, _ in _COLUMNS]
        means = " | ".join(f"{np.mean(p):.3f}" for p in pooled)
        lines.append(f"| {name} ({len(group)}) | {means} | " + " | ".join(cells) + " |")
    return lines


def _per_sequence(group: list[dict[str, Any]], key: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A metric a sequence; the mean over seeds where a sequence was tested by several runs."""
    values: dict[str, list[float]] = {}
    for r in group:
        for s, v in zip(r["sequences"], column([r], key), strict=True):
            values.setdefault(s["name"], []).append(float(v))
    return np.array([np.mean(values[n]) for n in sorted(values)])


def _tests(found: list[dict[str, Any]]) -> list[str]:
    """Every family against the first of `_AGAINST` that shares its sequences and seeds."""
    lines = []
    names = {family(r["name"]) for r in found}
    for a, b in _AGAINST:
        if not {a, b} <= names:
            continue
        # Only folds and seeds that both have.
        tags = [{r["name"].split(n, 1)[1] for r in found if family(r["name"]) == n} for n in (a, b)]
        both = tags[0] & tags[1]
        groups = [[r for r in found if r["name"] in {n + t for t in both}] for n in (a, b)]
        for key, label in _COLUMNS:
            a_values, b_values = (_per_sequence(g, key) for g in groups)
            if not np.isfinite(b_values - a_values).any():
                continue
            test = paired(a_values, b_values, np.random.default_rng(0))
            base = float(np.nanmean(a_values))
            change = f"{test.difference.mean / base:+.0%}" if base > 0 else "-"
            lines.append(
                f"- {b} against {a}, {label}: {_text(test.difference)} ({change}), p = {test.p:.2g}, "
                f"{test.difference.n} sequences, {len(both)} runs each"
            )
    return lines


_AGAINST = (
    ("mse", "antighost"),
    ("mse", "published"),
    ("mse", "stem4"),
    ("mse", "unet"),
    ("mse", "vector"),
    ("ideal-on-recovered", "recovered"),
    ("ideal-on-recovered", "mixed"),
)


def _text(i: Interval) -> str:
    if not np.isfinite(i.mean):
        return "-"
    if not np.isfinite(i.low):
        return f"{i.mean:.3g}"
    return f"{i.mean:.3g} [{i.low:.3g}, {i.high:.3g}]"
