"""What `bench score` and `bench demo` run: a folder in, score.json and report.html out."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from bench.methods import plugins
from bench.methods.network import Model
from bench.methods.protocol import Method
from bench.output.progress_bar import counting
from bench.recording import pixel_scale
from bench.recording.folder import Recording, open_recording
from bench.recording.from_sequence import export_recording
from bench.scoring import evaluate_recording, report
from bench.scoring.evaluate_recording import Result, Settings
from bench.tracking import flow_process
from learn.inference.mask_files import MaskFiles
from learn.inference.predict import Predictor
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.system import whole_file

MAIN = "D2FNet"
"""Name under which the given model stands in every table."""
_ROOM_BYTES = 32 << 20  # score.json and report.html, with the charts' program in it
_MARK = "made-by-demo.txt"
_LONG = 100
"""Frames from which a second process is worth the seconds that it takes to start."""


@dataclass(frozen=True)
class Seen:
    """What of a recording's pictures is looked at, instead of what its folder says."""

    masks: MaskFiles | None = None
    """The tool's masks."""
    region: tuple[int, int, int, int] | None = None
    """Left, top, width and height [px]."""

    def within(self, recording: Recording) -> Recording:
        """The recording so seen."""
        masked = recording if self.masks is None else recording.with_masks(self.masks)
        return replace(masked, region=self.region)


def score(
    recording: str | Path,
    model: str | Path | Predictor | None = None,
    *,
    methods: Mapping[str, Method] | None = None,
    baselines: bool = True,
    train: str | Path | None = None,
    settings: Settings | None = None,
    out: str | Path | None = None,
    title: str = "",
    progress: bool = False,
) -> Result:
    """Scores a model, methods of one's own, or both, on a recording; writes only where `out` says.

    Args:
        recording: its folder.
        model: of `learn.load_model`, or its folder; it is called D2FNet in the tables.
        methods: further ones by name; the first is what the result is about where there is no model.
        baselines: whether the simpler methods are scored beside.
        train: the dataset the model was trained on; those that need data are fitted on the same sequences.
        settings: flow back end, rate, masks; as the command's if None.
        out: folder for score.json and report.html.
        title: heading of the report.
        progress: whether a bar is drawn, in a terminal or a notebook.

    Returns:
        `Result.methods[name].scores` has the numbers, `Result.time_s` and `.size_mn` of each the curves.

    Raises:
        UserError: recording, model or settings that can't be used, or nothing to score.
    """
    if model is None and not methods:
        raise UserError("score: nothing to score; give a model or methods")
    if train is not None and (model is None or isinstance(model, Predictor)):
        raise UserError("score: train needs the model's folder, which says what it was fitted on")
    network = None if model is None else Model(model if isinstance(model, Predictor) else Path(model))
    chosen: dict[str, Method] = {MAIN: network} if network else {}
    chosen |= methods or {}
    opened = open_recording(Path(recording))
    if baselines:
        folder = Path(model) if isinstance(model, (str, Path)) else None
        two_eyes = bool(opened.right or opened.depths)
        simple = fit_baselines(Path(train) if train else None, folder, two_eyes)
        chosen = {**chosen, **{name: one for name, one in simple.items() if name not in chosen}}
    bar = counting(f"scoring {opened.name}", opened.expected_frames()) if progress else nullcontext(_untold)
    with bar as told:
        result = evaluate_recording.evaluate_recording(
            opened,
            chosen,
            MAIN if network else next(iter(chosen)),
            pixel_scale.find_scale(opened.meta, opened.folder),
            settings or Settings(),
            {"model": network.described()} if network else {},
            told,
        )
    if out is not None:
        with whole_file.made_folder(Path(out), _ROOM_BYTES):
            write_result(result, Path(out), title)
    return result


def _untold(done: int) -> None:
    """A progress that nobody is told of."""


def write_result(result: Result, folder: Path, title: str) -> None:
    """Writes score.json and report.html: both are whole before either has its name."""
    with (
        whole_file.part_of(folder / "score.json") as scores,
        whole_file.part_of(folder / "report.html") as page,
    ):
        evaluate_recording.write_json(result, scores)
        report.write_report(result, page, title)


def score_recording(
    recording: Path,
    model: Path,
    out: Path | None,
    settings: Settings,
    title: str = "",
    train: Path | None = None,
    also: Mapping[str, Path] | None = None,
    phantom: bool = False,
    seen: Seen = Seen(),
) -> Result:
    """Scores one recording and writes score.json and report.html, both whole or not at all.

    Args:
        recording: its folder.
        model: folder of `learn train`.
        train: the dataset the model was trained on; simpler methods are fitted on the same sequences.
        also: further models by name.
        out: folder for the results; `NAME-score` here if None.
        settings: of this run.
        title: heading of the report.
        phantom: the recording shows one, so that its forces may be beyond any brain's.
        seen: other masks than the recording's, and a region of interest.

    Raises:
        UserError: recording, model or settings that can't be used; nothing is written then.
    """
    from learn.training.threads import set_threads

    # NumPy's BLAS too: a second thread of its own waits for a core that the flow has.
    threadpool_limits(set_threads(None))
    opened = seen.within(open_recording(recording, phantom))
    folder = out or Path(f"{opened.name}-score")
    with whole_file.made_folder(folder, _ROOM_BYTES):
        result = _score(opened, model, settings, train, also)
        write_result(result, folder, title)
    return result


def _score(
    opened: Recording, model: Path, settings: Settings, train: Path | None, also: Mapping[str, Path] | None
) -> Result:
    total = opened.expected_frames()
    # Started first, for it takes seconds to begin; the methods are fitted meanwhile.
    with flow_process.elsewhere() if (total or _LONG) >= _LONG else nullcontext() as flow:
        # Quick as in `learn predict`: to the last digit the same network.
        network = Model(model, quick=True)
        methods: dict[str, Method] = {MAIN: network}
        methods |= {name: Model(folder, quick=True) for name, folder in (also or {}).items()}
        methods |= fit_baselines(train, model, bool(opened.right or opened.depths))
        found = pixel_scale.find_scale(opened.meta, opened.folder)
        with counting(f"scoring {opened.name}", total) as progress:
            about: dict[str, object] = {"model": network.described()}
            if sources := plugins.sources():
                about["plug_ins"] = sources
            return evaluate_recording.evaluate_recording(
                opened, methods, MAIN, found, settings, about, progress, flow
            )


def fit_baselines(train: Path | None, model: Path | None, two_eyes: bool = False) -> dict[str, Method]:
    """Those that need no data, those of installed packages, and, given the training data, the fitted ones.

    These are fitted on the model's own fit sequences.

    They are fitted once for a model, and kept for its next recording; for one with a second eye on motion in
    three dimensions, if the data have it.

    Raises:
        UserError: none of the model's sequences is in `train`.
    """
    from bench.methods import baselines as baseline
    from bench.methods import kept_rules

    methods = baseline.physical()
    others = plugins.installed()
    if taken := {MAIN, *methods, *baseline.FITTED} & set(others):
        raise UserError(f"method {min(taken)}: a plug-in's name is taken by one of ours; rename it")
    methods |= others
    if train is None or model is None:
        return methods
    from learn.checkpoint import read_card
    from learn.data.clips import read_clip

    hashes = set(read_card(model).split.get("fit", []))
    chosen = [s for s in Dataset(train) if s.attrs["content_hash"] in hashes]
    if not chosen:
        raise UserError(f"{train}: holds none of the sequences that {model} was fitted on")
    source = "recovered" if all("flow_recovered" in s for s in chosen) else "ideal"
    if two_eyes and all("motion_recovered" in s for s in chosen):
        source = "motion"

    def fit() -> dict[str, baseline.Rule]:
        return baseline.fitted_rules([read_clip(s, baseline.GRID, (source,)) for s in chosen], source)

    rules = kept_rules.keep_rules([s.attrs["content_hash"] for s in chosen], source, fit)
    space: baseline.Space = "always" if source == "motion" else "never"
    return methods | {name: baseline.Baseline(rule, space) for name, rule in rules.items()}


def score_demo(dataset: Path, model: Path, out: Path, settings: Settings) -> Result:
    """Exports a sequence that the model has not seen as a recording, and scores it.

    Args:
        dataset: where the model's training data came from.
        model: folder of `learn train`.
        out: gets recording/, score.json and report.html; what an earlier demo left there is replaced.

    Raises:
        UserError: the model has seen every sequence, a recording/ that no demo left, or as
            `score_recording`.
    """
    chosen = find_unseen(dataset, model)
    folder = out / "recording"
    if folder.is_symlink():
        raise UserError(f"{folder}: is a link, which is not followed; remove it")
    if folder.exists():
        if not (folder / _MARK).is_file():
            raise UserError(f"{folder}: not from `bench demo`, so not replaced; remove it, or say --out")
        shutil.rmtree(folder)
    export_recording(chosen, folder)
    (folder / _MARK).write_text("`bench demo` wrote this folder and replaces it when it runs again.\n")
    return score_recording(
        folder, model, out, settings, f"Force from video: sequence {chosen.index}, unseen in training"
    )


def find_unseen(dataset: Path, model: Path) -> Sequence:
    """The first sequence that the model was neither fitted nor chosen on. UserError if there is none."""
    from learn.checkpoint import SEEN, read_card

    split = read_card(model).split
    seen = {name for part in SEEN for name in split.get(part, [])}
    for sequence in Dataset(dataset):
        if sequence.attrs["content_hash"] not in seen:
            return sequence
    raise UserError(f"{dataset}: the model was fitted or chosen on every sequence here")
