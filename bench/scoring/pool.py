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
    found = []
    for path in paths:
        try:
            tree = checked_file.read_json(path / "score.json" if path.is_dir() else path)
        except UserError as error:
            raise UserError(f"{path}: no readable score.json ({error})") from None
        if not isinstance(tree, dict) or tree.get("format") != "sulcus-score":
            raise UserError(f"{path}: not written by `bench score`")
        check_format(tree.get("format_version", 1), SCORE, str(path))
        found.append(tree)
    if not found:
        raise UserError("no scores to pool")
    names = [tree["recording"] for tree in found]
    if twice := {name for name in names if names.count(name) > 1}:
        raise UserError(f"recording {min(twice)} is given twice")
    if all(_fault(tree) for tree in found):
        why = "; ".join(f"{tree['recording']}: {_fault(tree)}" for tree in found)
        raise UserError(f"no recording can be pooled ({why})")
    mains = {_identity(tree, tree["main"]): f"{tree['main']} of {tree['recording']}" for tree in found}
    if len(mains) > 1:
        differ = ", ".join(mains.values())
        raise UserError(f"the main methods differ ({differ}): pool scores of one main method")
    return found


def pool(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over the scored recordings, with 95% intervals over specimens, for methods that all have."""
    every, found = found, [tree for tree in found if not _fault(tree)]
    specimens = [tree["settings"]["meta"].get("specimen") or tree["recording"] for tree in found]
    main = found[0]["main"]
    names = [{_identity(tree, name): name for name in tree["methods"]} for tree in found]
    scored = [
        {i: tree["methods"][name] for i, name in one.items()} for tree, one in zip(found, names, strict=True)
    ]
    common = [identity for identity in scored[0] if all(identity in one for one in scored)]
    first = _identity(found[0], main)

    def values(method: str, part: str, key: str) -> Floats:
        return np.array([one[method][part].get(key) for one in scored], np.float64)  # None: NaN

    methods: dict[str, Any] = {}
    for identity in common:
        name = names[0][identity]
        worse = values(first, "scores", "mae_mn") - values(identity, "scores", "mae_mn")
        methods[name] = {
            "identity": identity,
            "scores": {key: _mean(values(identity, "scores", key), specimens) for key in SCORES},
            "calibrated": {key: _mean(values(identity, "calibrated", key), specimens) for key in _CALIBRATED},
            "main_worse_by_mn": None if name == main else _mean(worse, specimens),
        }
    return {
        "format": "sulcus-pool",
        "version": 1,
        "main": main,
        "recordings": [tree["recording"] for tree in found],
        "left_out": {tree["recording"]: fault for tree in every if (fault := _fault(tree))},
        "each": [_one_recording(tree) for tree in found],
        "of_some": sorted({name for one in names for i, name in one.items() if i not in common}),
        "specimens": len(set(specimens)),
        "frames": sum(tree["frames"] for tree in found),
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


def _one_recording(tree: dict[str, Any]) -> dict[str, Any]:
    """One recording's main scores and the alignment of its clocks."""
    found = tree.get("sync") or {}
    return {
        "recording": tree["recording"],
        "frames": tree["frames"],
        **{key: tree["scores"].get(key) for key in ("event_peak_mn", "mae_of_peak", "r")},
        "offset_s": found.get("offset_s"),
        "offset_deviation_s": found.get("deviation_s"),
        "lost": (tree.get("lost") or {}).get("share"),
    }


def _mean(values: Floats, specimens: Sequence[str]) -> dict[str, float | None]:
    """Mean of the finite values and its interval; None if undefined or from too few specimens."""
    found = over_groups(values, specimens, np.random.default_rng(0))
    mean: dict[str, float | None] = as_plain(replace(found, n=int(np.isfinite(values).sum())))
    return mean


def write(tree: dict[str, Any], out: Path, command: str) -> None:
    """Writes pool.json and README.md into the folder `out`."""
    tree = tree | {"command": command}
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / "pool.json", json.dumps(tree, indent=1, allow_nan=False) + "\n", durable=False)
    write_whole(out / "README.md", page(tree), durable=False)


def page(tree: Mapping[str, Any]) -> str:
    """The page in Markdown; methods with a smaller error than the main one are marked."""
    methods, count = tree["methods"], f"{len(tree['recordings'])} recordings"
    error = methods[tree["main"]]["scores"]["mae_mn"]["mean"]
    rows = []
    for name, found in methods.items():
        better = None not in (error, own := found["scores"]["mae_mn"]["mean"]) and own < error
        row = {"method": f"{name} (better)" if better else name}
        row |= {METRICS[key].heading: _text(found["scores"][key], METRICS[key].digits) for key in _SHOWN}
        row |= {
            head: _text(found["calibrated"][key], METRICS[key].digits) for key, head in _CALIBRATED.items()
        }
        rows.append(row)
    parts = [
        f"# {count}, {tree['specimens']} specimens, {tree['frames']} frames",
        f"    {tree['command']}",
        "Means over recordings; in brackets 95% intervals over specimens."
        if tree["specimens"] >= LEAST_GROUPS
        else f"Means over recordings, without intervals: those need at least {LEAST_GROUPS} specimens.",
        *(f"{name} is left out: not all recordings were scored with it." for name in tree["of_some"]),
        *(f"Recording {lost} is left out: {why}." for lost, why in tree["left_out"].items()),
        _table(rows),
        f"## By recording, {tree['main']}",
        _table([_row(one) for one in tree["each"]]),
    ]
    return "\n\n".join(parts) + "\n"


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table of rows with the same columns."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([*row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _row(one: Mapping[str, Any]) -> dict[str, str]:
    """One recording's row of the table."""
    known = {key: math.nan if value is None else value for key, value in one.items()}
    offset = f"{1e3 * known['offset_s']:.0f} ± {1e3 * known['offset_deviation_s']:.0f}"
    return {
        "recording": one["recording"],
        "frames": str(one["frames"]),
        "event peak [mN]": f"{known['event_peak_mn']:.2f}",
        "MAE of peak": f"{known['mae_of_peak']:.1%}",
        "r": f"{known['r']:.3f}",
        "clocks' offset [ms]": "–" if one["offset_s"] is None else offset,
    } | ({"lost": f"{one['lost']:.0%}"} if one.get("lost") is not None else {})


def _text(value: Mapping[str, float | None], digits: int) -> str:
    mean, low, high = (
        "–" if value[key] is None else f"{value[key]:.{digits}f}" for key in ("mean", "low", "high")
    )
    return mean if value["low"] is None else f"{mean} [{low}, {high}]"
