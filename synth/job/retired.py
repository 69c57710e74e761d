"""Keys that jobs and trainings once had, or had under another name: what older versions wrote is still read.

A key stands here with the value it had by default. At that value it is dropped without a word; at another one
what is stored can still be read, and only commit `LAST` makes more of it.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from synth.system.config_file import Mistake

LAST = "f047e99"
"""The last commit that knew all of these keys."""


@dataclass(frozen=True)
class Retired:
    """A key that went."""

    default: Any
    """What it stood at by default, as JSON holds it; a section: all its keys."""
    gone: tuple[Any, ...] = ()
    """Of a key that stays: the values that went; where one stood, `default` is read."""
    words: Mapping[str, Any] = field(default_factory=dict)
    """Of a section that is one word now: what each word stands for, `default` included."""
    renamed: str = ""
    """Of a key that stays: its name now."""


_LABELS = {
    "force_std_mn": 0.0,
    "force_share": 0.0,
    "force_bias_mn": 0.0,
    "outliers": 0.0,
    "outlier_scale": 10.0,
    "noisy_frames": 0.3,
    "noisy_points": 0.05,
    "noisy_range": 0.05,
}

JOB: dict[str, Retired] = {
    "fem.contact": Retired("traction"),
    "fem.tip": Retired("flat"),
    "fem.friction": Retired(0.2),
    "fem.depth_mm": Retired(None),
    "fem.law": Retired("neo-hookean", gone=("stable",)),
    "fem.order": Retired(2),
    "fem.volume": Retired("auto"),
    "fem.ramp": Retired([0.25, 0.35]),
    "flow.stereo": Retired("joint"),
    "render.subsurface": Retired("blur"),
    "appearance.own": Retired(
        dict.fromkeys(("crown", "flush", "vein", "wine", "arterial", "capillary", "shade", "film_mm"))
    ),
    "fem.tolerance": Retired(0.05),
    "fem.dt_s": Retired(0.03),
    "fem.density_kg_m3": Retired(1040.0),
    "fem.damping": Retired(2.0),
    "fem.membrane.stretch": Retired([1.01, 1.03]),
    "anatomy.block_mm": Retired([100.0, 100.0, 60.0]),
    "anatomy.craniotomy.rim_mm": Retired(3.0),
    "anatomy.vessel_density": Retired(1.0),
    "anatomy.vessel_calibre": Retired(1.0),
    "light.power": Retired([0.95, 1.1]),
    "light.drift": Retired([0.0, 0.03]),
    "sensor.contrast": Retired([0.25, 0.55]),
    "sensor.depth": Retired(8),
    "sensor.subframes": Retired(4),
    "render.off_centre": Retired([0.0, 0.0]),
    "fem.crew": Retired([], renamed="instrument_list"),
    "fem.within_mm": Retired(None, renamed="contact_region_radius_mm"),
    "fem.cone_deg": Retired(65.0, renamed="max_tilt_deg"),
    "fem.membrane.intact": Retired(0.0, renamed="probability"),
    "labels": Retired(_LABELS, words={"none": _LABELS, "published": {**_LABELS, "force_share": 0.02}}),
}
"""Of a job: a dotted key each."""

TRAINING: dict[str, Retired] = {
    "arch.name": Retired("d2fnet"),
    "arch.detail": Retired(False),
    "arch.bounds": Retired([0.25, 0.75, 1.5]),
    "arch.total": Retired(False),
    "arch.condition": Retired("none"),
    "arch.prior": Retired("none"),
    "arch.window": Retired(1),
    "weight_decay": Retired(1e-5),
    "patience": Retired(5),
    "stop": Retired(0),
    "clip": Retired(1.0),
    "augment": Retired(True),
    "resident": Retired("auto"),
    "deterministic": Retired(False),
}
"""Of the settings in a model's config.json."""

PRESETS = {"eyes": "stereo", "eyes-live": "stereo-live"}
"""Names that presets of training had, and have."""


def drop(values: Mapping[str, Any], table: Mapping[str, Retired]) -> tuple[dict[str, Any], dict[str, Any]]:
    """`values`, nested mappings, without retired keys; and those that were not at their default.

    Returns:
        (values, others): others is `{dotted key: value}`.
    """
    left, others = copy.deepcopy(dict(values)), {}
    for key, one in table.items():
        *blocks, name = key.split(".")
        block = _block(left, blocks)
        if block is None or name not in block or (one.gone and block[name] not in one.gone):
            continue
        if one.words and not isinstance(block[name], dict | None):
            continue
        if one.renamed:
            if one.renamed not in block:  # else it is refused, as any key that isn't known
                block[one.renamed] = block.pop(name)
            continue
        value = block.pop(name)
        word = next((word for word, stood in one.words.items() if _same(value, stood, one.default)), None)
        if one.gone or word:
            block[name] = word or one.default
        if not word and not _same(value, one.default, one.default):
            others[key] = value
    return left, others


def restore(values: Mapping[str, Any], table: Mapping[str, Retired]) -> dict[str, Any]:
    """`values` with every retired key at its default, as they were written at `LAST`."""
    tree = copy.deepcopy(dict(values))
    for key, one in table.items():
        if one.gone:
            continue
        *blocks, name = key.split(".")
        block = tree
        for step in blocks:
            block = block.setdefault(step, {})
        if one.renamed in block:
            block[name] = block.pop(one.renamed)
            continue
        block[name] = copy.deepcopy(one.words.get(block.get(name, ""), one.default))
    return tree


def mistakes(others: Mapping[str, Any]) -> list[Mistake]:
    """What to say of retired keys that ask for something, `others` of `drop`."""
    return [
        Mistake(
            tuple(key.split(".")),
            f"{json.dumps(value, default=str)[:80]} is gone; commit {LAST} still has it",
            of_key=True,
        )
        for key, value in others.items()
    ]


def _block(tree: Any, path: list[str]) -> dict[str, Any] | None:
    for step in path:
        tree = tree.get(step) if isinstance(tree, dict) else None
    return tree if isinstance(tree, dict) else None


def _same(value: Any, other: Any, default: Any) -> bool:
    """Equal as JSON; of a section, with the defaults of what isn't given of it."""
    if isinstance(default, dict) and (value is None or isinstance(value, dict)):
        return bool({**default, **(value or {})} == other)
    return bool(json.loads(json.dumps(value, default=str)) == other)
