"""What `bench score` and `bench demo` run: a folder in, score.json and report.html out."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from bench.methods import plugins
from bench.methods.network import Model
from bench.methods.protocol import Method
from bench.recording import pixel_scale
from bench.recording.folder import Recording, open_recording
from bench.recording.from_sequence import export_recording
from bench.scoring import report
from bench.scoring.evaluate_recording import evaluate_recording
from bench.scoring.result import Result, write_json
from bench.tracking import flow_process
from bench.tracking.tracking import Progress
from learn.inference.predict import Predictor
from learn.inference.shipped import NONE, choose_model, find_model, shipped
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.recording_flow.video_flow import FlowHere, Settings
from synth.system import checked_file
from synth.system.terminal import counting
from synth.video.mask_files import MaskFiles

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
        model: of `learn.load_model`, its folder, mono or stereo; it is called D2FNet in the tables. Where
            neither it nor methods are given, what comes with this version.
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
    if model is None and not methods and not shipped():
        raise UserError("score: nothing to score; give a model or methods")
    if train is not None and (model is None or isinstance(model, Predictor)):
        raise UserError("score: train needs the model's folder, which says what it was fitted on")
    opened = open_recording(Path(recording))
    folder = None
    if not isinstance(model, Predictor) and (model is not None or not methods):
        folder = _folder(model, opened)
    network = Model(model) if isinstance(model, Predictor) else Model(folder) if folder else None
    chosen = dict(methods or {})
    if baselines:
        simple = fit_baselines(Path(train) if train else None, folder, _two_eyes(opened))
        chosen |= {name: one for name, one in simple.items() if name not in chosen}
    bar: AbstractContextManager[Progress] = nullcontext(lambda done: None)
    if progress:
        bar = counting(f"scoring {opened.name}", opened.expected_frames())
    with bar as told:
        result = _evaluate(opened, network, chosen, settings or Settings(), told)
    if out is not None:
        checked_file.make_folder(Path(out), _ROOM_BYTES)
        write_result(result, Path(out), title)
    return result


def _evaluate(
    opened: Recording,
    network: Model | None,
    methods: Mapping[str, Method],
    settings: Settings,
    progress: Progress,
    flow: FlowHere | None = None,
) -> Result:
    """Of the network, if there is one, and the methods after it."""
    described: dict[str, object] = {} if network is None else {"model": network.described()}
    if sources := {name: where for name, where in plugins.sources().items() if name in methods}:
        described["plug_ins"] = sources
    scale = pixel_scale.find_scale(opened.meta, opened.folder)
    chosen = {**({MAIN: network} if network else {}), **methods}
    main = next(iter(chosen))
    return evaluate_recording(opened, chosen, main, scale, settings, described, progress, flow)


def _two_eyes(opened: Recording) -> bool:
    return bool(opened.right or opened.depths)


def _folder(model: str | Path | None, opened: Recording) -> Path:
    """Of the model to score: the one named, else what comes along for so many eyes. UserError if nothing."""
    found = choose_model(_two_eyes(opened)) if model is None else find_model(model)
    if found is None:
        raise UserError(f"say --model: {NONE}")
    return found


def write_result(result: Result, folder: Path, title: str) -> None:
    """Writes score.json and report.html: both are whole before either has its name."""
    with (
        checked_file.part_of(folder / "score.json") as scores,
        checked_file.part_of(folder / "report.html") as page,
    ):
        write_json(result, scores)
        report.write_report(result, page, title)


def score_recording(
    recording: Path,
    model: Path | None,
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
        model: folder of `learn train`, mono or stereo; None: what comes with this version.
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
    chosen = _folder(model, opened)
    folder = out or Path(f"{opened.name}-score")
    with checked_file.made_folder(folder, _ROOM_BYTES):
        total = opened.expected_frames()
    # Started first, for it takes seconds to begin; the methods are fitted meanwhile.
    with flow_process.elsewhere() if (total or _LONG) >= _LONG else nullcontext() as flow:
        # Quick as in `learn predict`: to the last digit the same network.
        methods: dict[str, Method] = {name: Model(at, quick=True) for name, at in (also or {}).items()}
        methods |= fit_baselines(train, chosen, _two_eyes(opened))
        with counting(f"scoring {opened.name}", total) as told:
            result = _evaluate(opened, Model(chosen, quick=True), methods, settings, told, flow)
    write_result(result, folder, title)
    return result


def fit_baselines(train: Path | None, model: Path | None, two_eyes: bool = False) -> dict[str, Method]:
    """Those that need no data, those of installed packages, and, given the training data, the fitted ones.

    These are fitted on the model's own fit sequences, once for a model; for a recording with a second eye on
    motion in three dimensions, if the data have it.

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

    hashes = set(read_card(find_model(model)).split.get("fit", []))
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
    if folder.is_symlink() or folder.exists():
        if folder.is_symlink() or not (folder / _MARK).is_file():
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

    split = read_card(find_model(model)).split
    seen = {name for part in SEEN for name in split.get(part, [])}
    for sequence in Dataset(dataset):
        if sequence.attrs["content_hash"] not in seen:
            return sequence
    raise UserError(f"{dataset}: the model was fitted or chosen on every sequence here")
