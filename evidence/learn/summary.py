"""The study's runs as a table that a reader can check: means over sequences, BCa intervals, paired tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.output.result_page import markdown
from evidence.learn.run_table import column, read
from learn.evaluation.metrics import METRICS
from learn.evaluation.statistics import Interval, interval, paired, pooled_r2, pooled_r2_difference
from learn.loss import SHARES

COLUMNS = tuple(
    (key, METRICS[key].column)
    for key in (
        "map_r2",
        "map_rmse",
        "force_mae",
        "peak_error_share",
        "ghost_relative",
        "ghost_far",
        "stray_mn",
        "low_over_mn",
        "localisation_mm",
    )
)


def family(name: str) -> str:
    """What a run compares: its name without fold and seed."""
    return name.split("-fold")[0]


def write(out: Path) -> None:
    """The tables of `out`/README.md from all runs found in `out`; what stands above them stays."""
    parts = []
    for folder in sorted(p.parent for p in out.glob("*/runs.json")):
        found = read(folder)
        parts += [f"## {folder.name}", "", *_table(found), "", *_tests(found), ""]
        for title, rows in (
            ("What is known of E", _stiffness(found)),
            ("Controls, of the trained models", _controls(found)),
            ("Each term's share of the gradient on the map, first and last epoch", _gradient(found)),
            ("Total force by band of true force (shares of the largest in training)", _bands(found)),
        ):
            parts += [f"### {title}", "", markdown(rows), ""] if rows else []
    page = out / "README.md"
    head = page.read_text("utf-8").split(_TABLES)[0] if page.is_file() else "# Learn: results\n\n"
    page.write_text(f"{head}{_TABLES}\n\n" + "\n".join(parts), "utf-8")


_TABLES = "<!-- From here on: written by `bench experiment learn`. -->"


def _table(found: list[dict[str, Any]]) -> list[str]:
    names = sorted({family(r["name"]) for r in found})
    lines = ["| runs | pooled map R² | pooled force R² | " + " | ".join(c for _, c in COLUMNS) + " |"]
    lines.append("|" + " --- |" * (len(COLUMNS) + 3))
    for name in names:
        group = [r for r in found if family(r["name"]) == name]
        pooled = [[r["columns"]["known"][k] for r in group] for k in ("map_r2_pooled", "force_r2_pooled")]
        cells = [_text(interval(_per_sequence(group, k), np.random.default_rng(0))) for k, _ in COLUMNS]
        sure = _pooled(group)
        means = f"{sure if sure else f'{np.mean(pooled[0]):.3f}'} | {np.mean(pooled[1]):.3f}"
        lines.append(f"| {name} ({len(group)}) | {means} | " + " | ".join(cells) + " |")
    return lines


def families(found: list[dict[str, Any]], key: str) -> list[tuple[str, int, Interval]]:
    """Name, number of runs, and the mean of a metric over tested sequences, of each family of runs."""
    out = []
    for name in sorted({family(r["name"]) for r in found}):
        group = [r for r in found if family(r["name"]) == name]
        out.append((name, len(group), interval(_per_sequence(group, key), np.random.default_rng(0))))
    return out


def _pooled(group: list[dict[str, Any]]) -> str:
    """R² over all cells of all tested sequences, each tested once: folds together, the mean over seeds."""
    seeds: dict[str, list[list[float]]] = {}
    for r in group:
        if any("map_moments" not in s for s in r["sequences"]):
            return ""
        seeds.setdefault(r["name"].split("-seed")[-1], []).extend(
            s["map_moments"][:6] for s in r["sequences"]
        )
    found = [pooled_r2(np.array(m), np.random.default_rng(0)) for m in seeds.values()]
    mean, low, high = (float(np.mean([getattr(i, k) for i in found])) for k in ("mean", "low", "high"))
    return _text(Interval(mean, low, high, found[0].n))


def _stiffness(found: list[dict[str, Any]]) -> list[dict[str, object]]:
    """Every E column of the runs that were also scored with a calibration press."""
    rows: list[dict[str, object]] = []
    for r in (r for r in found if "press" in r["columns"]):
        for young, c in r["columns"].items():
            row: dict[str, object] = {"run": r["name"], "E": young}
            row |= {"force R²": c["force_r2_pooled"], "force MAE [mN]": c["force_mae"]}
            rows.append(row | {"map R²": c["map_r2_pooled"], "E off, median": None})
        rows[-1]["E off, median"] = f"{r['press_young_off']:.0%}"
    return rows


def _controls(found: list[dict[str, Any]]) -> list[dict[str, object]]:
    shown = ("map_r2_pooled", "force_r2_pooled", "map_rmse", "ghost_relative")
    heads = {key: METRICS[key].column for key in shown}
    rows: list[dict[str, object]] = []
    for r in found:
        if r["name"] in _SHOWN:
            rows += [
                {"run": r["name"], "control": k} | {heads[h]: v[h] for h in heads}
                for k, v in r["controls"].items()
            ]
        if r["control"]:
            known = r["columns"]["known"]
            rows.append({"run": r["name"], "control": r["control"]} | {heads[h]: known[h] for h in heads})
        if "beyond_mean_map" in r:
            base = r["controls"]["mean map"]
            rows.append({"run": r["name"], "control": "mean map"} | {heads[h]: base[h] for h in heads})
            beyond = {k: Interval(**v, n=0) for k, v in r["beyond_mean_map"].items()}
            rows.append(
                {"run": r["name"], "control": f"{r['control']}, beyond the mean map"}
                | {heads[f"{k}_r2_pooled"]: _text(i) for k, i in beyond.items()}
            )
    return rows


def _gradient(found: list[dict[str, Any]]) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for r in (
        r for r in found if r["name"].endswith("fold0-seed0") and r["settings"]["objective"]["kind"] != "mse"
    ):
        ends = r["history"][0], r["history"][-1]
        rows.append(
            {"run": r["name"]} | {k: " → ".join(f"{e[f'share_{k}']:.0%}" for e in ends) for k in SHARES}
        )
    return rows


def _bands(found: list[dict[str, Any]]) -> list[dict[str, object]]:
    return [
        {
            "run": r["name"],
            "band": f"{b['from']:.2f} to {b['to']:.2f}",
            "frames": int(b["frames"]),
            "MAE [mN]": b["mae_mn"],
            "bias [mN]": b["bias_mn"],
        }
        for r in found
        if r["name"] in _SHOWN
        for b in r["bands"]
    ]


_SHOWN = ("mse-fold0-seed0", "ghostless-fold0-seed0", "long-fold0-seed0")
"""Runs that the detailed tables are of."""


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
        said, count = _pooled_difference(groups), 0
        for key, label in COLUMNS:
            a_values, b_values = (_per_sequence(g, key) for g in groups)
            if not np.isfinite(b_values - a_values).any():
                continue
            test = paired(a_values, b_values, np.random.default_rng(0))
            base = float(np.nanmean(a_values))
            change = f"{test.difference.mean / base:+.0%}, " if base > 0 else ""
            said.append(f"{label} {_text(test.difference)} ({change}p {test.p:.2g})")
            count = max(count, test.difference.n)
        runs = "one run" if len(both) == 1 else f"{len(both)} runs"
        lines.append(f"- **{b} against {a}**, {count} sequences, {runs} each: {'; '.join(said)}")
    return lines


def _pooled_difference(groups: list[list[dict[str, Any]]]) -> list[str]:
    """The second group's pooled R² less the first's, where both tested every sequence in each run."""
    rows = [{s["name"]: s.get("map_moments") for s in r["sequences"]} for g in groups for r in g]
    names = sorted(rows[0])
    if any(sorted(row) != names or None in row.values() for row in rows):
        return []
    both = [
        np.array([[row[n][:6] for row in part] for n in names])
        for part in (rows[: len(groups[0])], rows[len(groups[0]) :])
    ]
    found = pooled_r2_difference(both[0], both[1], np.random.default_rng(0))
    return [f"pooled map R² {_text(found)}"]


_AGAINST = (
    ("mse", "ghostless"),
    ("mse", "published"),
    ("published", "ghostless"),
    ("mse", "capped"),
    ("mse", "hinge"),
    ("hinge", "ghostless"),
    ("r2-frame", "ghostless"),
    ("mse", "antighost"),
    ("antighost", "antighost-frame"),
    ("mse", "unet"),
    ("mse", "monai-unet"),
    ("mse", "film"),
    ("mse", "total"),
    ("mse", "vector"),
    ("vec-mse", "vec-ghostless"),
    ("mse", "stem4"),
    ("mse", "stem4-detail"),
    ("stem2", "stem4"),
    ("stem2", "stem4-detail"),
    ("stem1", "stem4-detail"),
    ("ideal-on-recovered", "recovered"),
    ("ideal-on-recovered", "mixed"),
)


def _text(i: Interval) -> str:
    if not np.isfinite(i.mean):
        return "-"
    if not np.isfinite(i.low):
        return f"{i.mean:.3g}"
    return f"{i.mean:.3g} [{i.low:.3g}, {i.high:.3g}]"
