"""Scores and coverage as `learn eval` prints them."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table

from learn.evaluation.coverage import Coverage
from learn.evaluation.evaluate import EvaluationReport
from learn.evaluation.metrics import METRICS, Metric

FIRST = ("force_mae", "force_r2_pooled", "peak_error_share", "map_r2_pooled")  # printed without --all


def score_table(report: EvaluationReport, title: str, all: bool) -> Table:
    """Means over sequences; `all`: every score."""
    table, means, intervals = open_table(title, "mean [95%]"), report.summary(), report.intervals()
    for key, metric in METRICS.items():
        if key in means and (metric.listed if all else key in FIRST):
            cell = _cell(metric, means[key])
            if key in intervals and intervals[key].low == intervals[key].low:
                cell += f" [{_cell(metric, intervals[key].low)}, {_cell(metric, intervals[key].high)}]"
            table.add_row(metric.heading, cell)
    return table


def coverage_table(covered: Sequence[Coverage]) -> Table:
    """Coverage and width of the model's intervals."""
    table = open_table("intervals", *(f"{coverage.level:.0%}" for coverage in covered))
    for key in covered[0].shares:
        shares = [coverage.shares[key] for coverage in covered]
        name = "force" if key == "size" else key
        table.add_row(f"{name} within", *(f"{s.mean:.0%} [{s.low:.0%}, {s.high:.0%}]" for s in shares))
    for name, key, spec in (
        ("width of the force's [mN]", "width_mn", ".3g"),
        ("the same over the peak", "width_of_peak", ".0%"),
        ("moving frames out of distribution", "out_of_distribution", ".0%"),
    ):
        table.add_row(name, *(format(coverage.values[key], spec) for coverage in covered))
    return table


def open_table(title: str, *heads: str, label: str = "") -> Table:
    """A table that fits eighty columns without breaking numbers: labels wrap, no vertical lines."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(label, overflow="fold")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    return table


def _cell(metric: Metric, value: float) -> str:
    return "-" if value != value else f"{value:.{metric.digits}g}"
