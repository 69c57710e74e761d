"""Generalisation of a force estimator over the mechanics of living tissue: membrane, pulse, slip.

Ridge is fitted on plain tissue and tested in every other condition, on scenes with other anatomies; then the
same after fitting on the mixture of all. Each condition is compared with the plain one on the same scenes.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from bench.methods.physics import GRID
from evidence import datasets, report
from evidence.datasets import coarser
from evidence.end_to_end import models
from evidence.end_to_end.models import RIDGE, Estimate
from evidence.intervals import difference, mean_of
from evidence.study import Study
from learn.data import clips as data
from learn.data.clips import Clip
from synth.dataset import location
from synth.dataset.folder import write_whole
from synth.errors import UserError
from synth.job.schema import Job

FRAMES, FPS, SIZE, VERTICES = 8, 8.0, (192, 144), 8000  # 1 s, one or two periods of the heart

PLAIN = "plain"
_UNTOUCHED = 1e-6  # load of a tool without effect
ON_PLAIN, ON_MIXTURE = "plain", "mixture"
PARTS = {"across": "the force across the line of sight", "whole": "the force"}
Errors = list[float | None]  # of every sequence [%]; None: refused


@dataclass(frozen=True)
class Condition:
    """Mechanical properties of tissue."""

    fem: Mapping[str, Any] = field(default_factory=dict)  # job keys in addition to the common ones
    removed: bool = False  # whether the untouched tissue's motion is subtracted: a perfect pulse removal
    mixed: bool = True  # whether it is in the mixture


_SOFT = {"probability": 1.0, "young_kpa": 100.0, "thickness_mm": 0.05}
_STIFF = {"probability": 1.0, "young_kpa": 1000.0, "thickness_mm": 0.2}
_PULSE = {"pulse": {"heart_mm": [0.1, 0.5], "breath_mm": [0.1, 1.0]}}
_ALIVE = _PULSE | {"membrane": {"probability": 1.0}}

CONDITIONS: dict[str, Condition] = {
    PLAIN: Condition(),
    "membrane, 5 mN/mm": Condition({"membrane": _SOFT}),
    "membrane, 200 mN/mm": Condition({"membrane": _STIFF}),
    "pulse": Condition(_PULSE),
    "pulse, removed": Condition(_PULSE, removed=True, mixed=False),
    "Poisson 0.49": Condition({"poisson": 0.49}),
    "slip at the skull": Condition({"skull": "slip"}),
    "in vivo": Condition(_ALIVE, mixed=False),
    "in vivo, removed": Condition(_ALIVE, removed=True, mixed=False),
}
"""All tested conditions. The membranes are the ends of the job's range of thickness times modulus; `in vivo`
is membrane and pulse together, as in the job of that name, and not in the mixture."""

MIXTURE = [name for name, one in CONDITIONS.items() if one.mixed]


def job(fem: Mapping[str, Any], seed: int, count: int, alone: bool = False) -> Job:
    """The job of sequences with some mechanics; if `alone` the tool has no effect."""
    return Job.model_validate(
        {
            "seed": seed,
            "sequences": count,
            "frames": FRAMES,
            "fps": FPS,
            "anatomy": {"vertices": VERTICES},
            # The law of the default job, for every load.
            "fem": {"gestures": ["pull", "push"], "law": "neo-hookean", **fem}
            | ({"load": _UNTOUCHED} if alone else {}),
            "render": {"size": SIZE, "spp": 1 if alone else 4},
            "flow": {"backend": "ideal" if alone else "tvl1"},
        }
    )


@dataclass(frozen=True)
class Scenes:
    """Sequences of one seed in every condition, rendered and packed when they are first used."""

    seed: int
    count: int
    work: Path

    def clip(self, name: str, index: int) -> Clip | str:
        """A sequence of a condition, with ideal and recovered displacement, or why it was refused."""
        one = CONDITIONS[name]
        clip = self._packed(one.fem, index)
        if not one.removed or isinstance(clip, str):
            return clip
        own = self._packed(one.fem, index, alone=True)
        return own if isinstance(own, str) else subtracted(clip, own)

    def _packed(self, fem: Mapping[str, Any], index: int, alone: bool = False) -> Clip | str:
        wanted = job(fem, self.seed, self.count, alone)
        folder = datasets.folder_of(wanted, "alone" if alone else "sequences", self.work)
        packed, refused = folder / f"{index:06d}", folder / f"{index:06d}.refused"
        if refused.is_file():
            return refused.read_text("utf-8")
        if not packed.is_file():
            try:
                sequence = datasets.render(wanted, index, folder)
            except UserError as refusal:
                write_whole(refused, str(refusal), durable=False)
                return str(refusal)
            data.pack(data.read_clip(sequence, GRID, ("ideal",) if alone else ("ideal", "recovered")), packed)
            shutil.rmtree(location.store(folder, index))
        return data.unpack(packed)


def subtracted(clip: Clip, own: Clip) -> Clip:
    """A clip less the tissue's own motion, the ideal displacement of `own`, in every frame.

    This is the exact removal of pulse and respiration, except that displacements don't add linearly in large
    strains.
    """
    pulse = own.displacement["ideal"]
    return replace(
        clip,
        content_hash=f"{clip.content_hash}-{own.content_hash}",
        displacement={name: moved - pulse for name, moved in clip.displacement.items()},
    )


def measure(
    work: Path = Path("runs/mechanics"), fit: int = 35, test: int = 12, seed: int = 41
) -> dict[str, Any]:
    """Error of a force estimator fitted on plain tissue, with other mechanics.

    `work`: folder of sequences, from which a later run continues; `fit`: sequences to fit on, plain and
    mixture each, at least 14; `test`: sequences to test on in every condition, at least 3.
    """
    fitted, tested = Scenes(seed, fit, work), Scenes(seed + 1, test, work)
    mixed = [MIXTURE[k % len(MIXTURE)] for k in range(fit)]  # each in turn
    used = {(tested, name, k): tested.clip(name, k) for name, k in product(CONDITIONS, range(test))}
    used |= {(fitted, name, k): fitted.clip(name, k) for k in range(fit) for name in (PLAIN, mixed[k])}
    refused = {where: clip for where, clip in used.items() if isinstance(clip, str)}
    known = {where: clip for where, clip in used.items() if not isinstance(clip, str)}
    rows = []
    for on, names in ((ON_PLAIN, [PLAIN] * fit), (ON_MIXTURE, mixed)):
        clips = [known.get((fitted, name, k)) for k, name in enumerate(names)]
        # Cells of twice the size suffice for a linear rule.
        ridge = models.build(RIDGE, [coarser(clip) for clip in clips if clip is not None])
        for name in CONDITIONS:
            errors = _errors(ridge, [known.get((tested, name, k)) for k in range(test)])
            rows.append({"model": RIDGE, "fit": on, "condition": name} | errors)
    return {
        "seed": seed,
        "fitted": {"sequences": fit, "mixture": MIXTURE},
        "refused": sorted(
            f"{name}, seed {of.seed}, sequence {k}: {why}" for (of, name, k), why in refused.items()
        ),
        "rows": rows,
    }


def _errors(ridge: Estimate, clips: Sequence[Clip | None]) -> dict[str, Errors]:
    found: dict[str, Errors] = {part: [] for part in PARTS}
    for clip in clips:
        off = None if clip is None else models.errors([ridge(coarser(clip))], [clip.force])
        for part, values in found.items():
            name = "errors" if part == "whole" else part
            values.append(None if off is None else round(100 * off[name][0], 1))
    return found


def page(found: Mapping[str, Any]) -> report.Page:
    """Errors of ridge fitted on plain tissue and fitted on the mixture, in each condition."""
    rows = {(row["model"], row["fit"], row["condition"]): row for row in found["rows"]}
    bars, sections, hurt = [], [], []

    def more(usual: Errors, other: Errors) -> str:
        return report.mean_cell(difference(usual, other), "+.0f")

    for part, what in PARTS.items():
        plain, table = rows[RIDGE, ON_PLAIN, PLAIN][part], []
        for name in CONDITIONS:
            own, mixture = (rows[RIDGE, on, name][part] for on in (ON_PLAIN, ON_MIXTURE))
            table.append(
                {
                    "condition": name,
                    "fitted on plain [%]": report.mean_cell(mean_of(own), ".0f"),
                    "difference from plain": None if name == PLAIN else more(plain, own),
                    "fitted on mixture, difference": more(own, mixture),
                }
            )
            for group, values in enumerate((own, mixture) if part == "across" else ()):
                (mean, low, high), on = difference(plain, values), ("plain", "the mixture")[group]
                bars.append(report.Row(f"{name}, fitted on {on}", mean, (low, high), group))
                if low > 0 and group == 0:
                    hurt.append(f"{name} ({mean:+.0f} points)")
        sections.append(report.Section(f"Error of {what}", table))
    refused, unit = [f"- {line}" for line in found["refused"]], "difference from plain [% of the force]"
    return report.Page(
        "Mechanics: generalisation of a force estimator",
        found,
        [report.Chart("Error across the line of sight", unit, tuple(bars))],
        [*sections, *([report.Section("Refused", words=refused)] if refused else [])],
        (
            "**After fitting on plain tissue the error across the line of sight is larger with "
            f"{'; '.join(hurt) or 'none of the conditions'}.**",
            "Conditions differ in mechanics alone: anatomy, contact, load and appearance are the same. Error "
            "of ridge on recovered flow: root mean square relative to that of the force, mean over "
            "sequences; differences are paired, intervals BCa. *Removed*: the tissue's own motion is "
            "subtracted exactly. Default jobs are plain; `mission` mixes membrane, slip and ν.",
        ),
    )


STUDY = Study(measure, "mechanics/results.json", page, ("--work {work}/mechanics",))
