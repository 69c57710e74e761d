"""Scores, coverage and paired tests as `learn eval` prints them."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table

from learn.evaluation.coverage import Coverage
from learn.evaluation.evaluate import YOUNG, EvaluationReport
from learn.evaluation.metrics import METRICS, Metric
from learn.evaluation.statistics import Paired

FIRST = ("force_mae", "force_r2_pooled", "peak_error_share", "map_r2_pooled")  # printed without --all


def score_table(report: EvaluationReport, title: str, all: bool) -> Table:
    """Means over sequences; `all`: every score, in every column of `YOUNG`."""
    heads = ("E known [95%]", "E × ½", "E × 2", "E unknown")[: 4 if all else 1]
    table = open_table(title, *heads)
    columns, sure = [report.summary(y) for y in YOUNG[: len(heads)]], report.intervals()
    for key, metric in _shown(columns[0], all).items():
        cells = [_cell(metric, c[key]) for c in columns]
        if key in sure and sure[key].low == sure[key].low:
            cells[0] += f" [{_cell(metric, sure[key].low)}, {_cell(metric, sure[key].high)}]"
        table.add_row(metric.heading, *cells)
    return table


def coverage_table(covered: Sequence[Coverage]) -> Table:
    """Coverage and width of the model's intervals."""
    table = open_table("intervals", *(f"{one.level:.0%}" for one in covered))
    for key in covered[0].shares:
        shares = [one.shares[key] for one in covered]
        name = "force" if key == "size" else key
        table.add_row(f"{name} within", *(f"{s.mean:.0%} [{s.low:.0%}, {s.high:.0%}]" for s in shares))
    for name, key, spec in (
        ("width of the force's [mN]", "width_mn", ".3g"),
        ("the same over the peak", "width_of_peak", ".0%"),
        ("moving frames out of distribution", "out_of_distribution", ".0%"),
    ):
        table.add_row(name, *(format(one.values[key], spec) for one in covered))
    return table


def paired_table(pairs: Mapping[str, Paired], title: str, all: bool) -> Table:
    """Differences, this model minus the other, sequence by sequence."""
    table = open_table(title, "difference [95%]", "p", "larger on")
    for key, metric in _shown(pairs, all).items():
        d, pair = pairs[key].difference, pairs[key]
        difference = f"{d.mean:+.3g} [{d.low:+.3g}, {d.high:+.3g}]"
        table.add_row(metric.heading, difference, f"{pair.p:.2g}", f"{pair.wins:.0%}")
    return table


def open_table(title: str, *heads: str, label: str = "") -> Table:
    """A table that fits eighty columns without breaking numbers: labels wrap, no vertical lines."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(label, overflow="fold")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    return table


def _shown(known: Container[str], all: bool) -> dict[str, Metric]:
    """Those of the `known` scores that have a row."""
    return {k: m for k, m in METRICS.items() if k in known and (m.listed if all else k in FIRST)}


def _cell(metric: Metric, value: float) -> str:
    return "-" if value != value else f"{value:.{metric.digits}g}"
