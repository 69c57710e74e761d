"""Pooled scores of several recordings: means over recordings, intervals over specimens."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.scoring.force_metrics import METRICS
from bench.scoring.result import MOST_LOST
from learn.evaluation.statistics import LEAST_GROUPS, as_plain, over_groups
from synth.arrays import Floats
from synth.errors import UserError
from synth.formats import SCORE, check_format
from synth.system import checked_file
from synth.system.checked_file import write_whole

_SHOWN = (
    "mae_mn", "mae_of_peak", "r", "shape_error", "ccc", "r2", "contact_f1", "false_positive_rate", "peak_mae",
)  # fmt: skip
SCORES = (*_SHOWN, "bias_mn", "impulse_mae", "dropout")
_CALIBRATED = {
    "mae_of_peak": f"{METRICS['mae_of_peak'].heading}, gain set",
    "r2": f"{METRICS['r2'].heading}, gain set",
    "gain": METRICS["gain"].heading,
}


def read(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """The score.json of each path (a file, or a folder of `bench score`). UserError for no path, a file of
    another kind, a recording twice, or main methods that differ."""
    trees = []
    for path in paths:
        try:
            tree = checked_file.read_json(path / "score.json" if path.is_dir() else path)
        except UserError as error:
            raise UserError(f"{path}: no readable score.json ({error})") from None
        if not isinstance(tree, dict) or tree.get("format") != "sulcus-score":
            raise UserError(f"{path}: not written by `bench score`")
        check_format(tree.get("format_version", 1), SCORE, str(path))
        trees.append(tree)
    if not trees:
        raise UserError("no scores to pool")
    names = [tree["recording"] for tree in trees]
    if duplicates := {name for name in names if names.count(name) > 1}:
        raise UserError(f"recording {min(duplicates)} is given twice")
    if all(_fault(tree) for tree in trees):
        why = "; ".join(f"{tree['recording']}: {_fault(tree)}" for tree in trees)
        raise UserError(f"no recording can be pooled ({why})")
    mains = {_identity(tree, tree["main"]): f"{tree['main']} of {tree['recording']}" for tree in trees}
    if len(mains) > 1:
        main_names = ", ".join(mains.values())
        raise UserError(f"the main methods differ ({main_names}): pool scores of one main method")
    return trees


def pool(trees: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over the scored recordings, with 95% intervals over specimens, for methods that all have."""
    all_trees, trees = trees, [tree for tree in trees if not _fault(tree)]
    specimens = [tree["settings"]["meta"].get("specimen") or tree["recording"] for tree in trees]
    main = trees[0]["main"]
    names = [{_identity(tree, name): name for name in tree["methods"]} for tree in trees]
    method_rows = [
        {i: tree["methods"][name] for i, name in by_identity.items()}
        for tree, by_identity in zip(trees, names, strict=True)
    ]
    common = [identity for identity in method_rows[0] if all(identity in row for row in method_rows)]
    first = _identity(trees[0], main)

    def gather(method: str, part: str, key: str) -> Floats:
        return np.array([row[method][part].get(key) for row in method_rows], np.float64)  # None: NaN

    methods: dict[str, Any] = {}
    for identity in common:
        name = names[0][identity]
        excess_mn = gather(first, "scores", "mae_mn") - gather(identity, "scores", "mae_mn")
        methods[name] = {
            "identity": identity,
            "scores": {key: _mean(gather(identity, "scores", key), specimens) for key in SCORES},
            "calibrated": {key: _mean(gather(identity, "calibrated", key), specimens) for key in _CALIBRATED},
            "main_worse_by_mn": None if name == main else _mean(excess_mn, specimens),
        }
    return {
        "format": "sulcus-pool",
        "version": 1,
        "main": main,
        "recordings": [tree["recording"] for tree in trees],
        "left_out": {tree["recording"]: fault for tree in all_trees if (fault := _fault(tree))},
        "each": [_summarise_recording(tree) for tree in trees],
        "of_some": sorted(
            {name for by_identity in names for i, name in by_identity.items() if i not in common}
        ),
        "specimens": len(set(specimens)),
        "frames": sum(tree["frames"] for tree in trees),
        "methods": methods,
    }


def _identity(tree: dict[str, Any], name: str) -> str:
    """A method's identity: a network's hash, a plug-in's name and version, else the name."""
    about = tree["settings"]
    if network := about.get("networks", {}).get(name):
        return str(network["hash"])
    return f"{name} {about.get('plug_ins', {}).get(name, '')}"


def _fault(tree: dict[str, Any]) -> str:
    """Why a recording is left out, as its own report has no numbers; empty if it is not."""
    if tree.get("fault"):
        return f"nothing can be measured: {tree['fault']}"
    lost = tree.get("lost") or {}
    if (lost.get("share") or 0.0) > lost.get("most", MOST_LOST):
        return f"{100 * lost['share']:.0f}% of its frames were lost"
    if refused := (tree.get("sync") or {}).get("refused"):
        return f"clocks not aligned: {refused}"
    return "" if tree["scores"] else "no sensor"


def _summarise_recording(tree: dict[str, Any]) -> dict[str, Any]:
    """One recording's main scores and the alignment of its clocks."""
    sync = tree.get("sync") or {}
    return {
        "recording": tree["recording"],
        "frames": tree["frames"],
        **{key: tree["scores"].get(key) for key in ("event_peak_mn", "mae_of_peak", "r")},
        "offset_s": sync.get("offset_s"),
        "offset_deviation_s": sync.get("deviation_s"),
        "lost": (tree.get("lost") or {}).get("share"),
    }


def _mean(values: Floats, specimens: Sequence[str]) -> dict[str, float | None]:
    """Mean of the finite values and its interval; None if undefined or from too few specimens."""
    statistics = over_groups(values, specimens, np.random.default_rng(0))
    plain: dict[str, float | None] = as_plain(replace(statistics, n=int(np.isfinite(values).sum())))
    return plain


def write(tree: dict[str, Any], out: Path, command: str) -> None:
    """Writes pool.json and README.md into the folder `out`."""
    tree = tree | {"command": command}
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / "pool.json", json.dumps(tree, indent=1, allow_nan=False) + "\n", durable=False)
    write_whole(out / "README.md", page(tree), durable=False)


def page(tree: Mapping[str, Any]) -> str:
    """The page in Markdown; methods with a smaller error than the main one are marked."""
    methods, count = tree["methods"], f"{len(tree['recordings'])} recordings"
    main_error = methods[tree["main"]]["scores"]["mae_mn"]["mean"]
    rows = []
    for name, method in methods.items():
        better = None not in (main_error, error := method["scores"]["mae_mn"]["mean"]) and error < main_error
        row = {"method": f"{name} (better)" if better else name}
        row |= {METRICS[key].heading: _text(method["scores"][key], METRICS[key].digits) for key in _SHOWN}
        row |= {
            head: _text(method["calibrated"][key], METRICS[key].digits) for key, head in _CALIBRATED.items()
        }
        rows.append(row)
    parts = [
        f"# {count}, {tree['specimens']} specimens, {tree['frames']} frames",
        f"    {tree['command']}",
        "Means over recordings; in brackets 95% intervals over specimens."
        if tree["specimens"] >= LEAST_GROUPS
        else f"Means over recordings, without intervals: those need at least {LEAST_GROUPS} specimens.",
        *(f"{name} is left out: not all recordings were scored with it." for name in tree["of_some"]),
        *(f"Recording {recording} is left out: {why}." for recording, why in tree["left_out"].items()),
        _table(rows),
        f"## By recording, {tree['main']}",
        _table([_row(recording) for recording in tree["each"]]),
    ]
    return "\n\n".join(parts) + "\n"


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table of rows with the same columns."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([*row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _row(recording: Mapping[str, Any]) -> dict[str, str]:
    """One recording's row of the table."""
    values = {key: math.nan if value is None else value for key, value in recording.items()}
    offset = f"{1e3 * values['offset_s']:.0f} ± {1e3 * values['offset_deviation_s']:.0f}"
    return {
        "recording": recording["recording"],
        "frames": str(recording["frames"]),
        "event peak [mN]": f"{values['event_peak_mn']:.2f}",
        "MAE of peak": f"{values['mae_of_peak']:.1%}",
        "r": f"{values['r']:.3f}",
        "clocks' offset [ms]": "–" if recording["offset_s"] is None else offset,
    } | ({"lost": f"{recording['lost']:.0%}"} if recording.get("lost") is not None else {})


def _text(value: Mapping[str, float | None], digits: int) -> str:
    mean, low, high = (
        "–" if value[key] is None else f"{value[key]:.{digits}f}" for key in ("mean", "low", "high")
    )
    return mean if value["low"] is None else f"{mean} [{low}, {high}]"
