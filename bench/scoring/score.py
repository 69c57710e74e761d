"""`bench.score` and `bench score`: from a recording to score.json and report.html."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from typing import Any

from bench.methods import comparison
from bench.methods.comparison import FUSION, MAIN, PHYSICS
from bench.methods.force_fusion import Fusion
from bench.methods.method_interface import Method
from bench.methods.method_plugins import PluginMethod
from bench.methods.network import Model
from bench.methods.physics import Physics
from bench.recording.recording_folder import Recording, open_recording
from bench.scoring import score_report
from bench.scoring.evaluate_recording import evaluate_recording
from bench.scoring.result import Result, as_json
from bench.tracking.tracking import Progress
from learn import Predictor
from learn.inference.shipped_networks import find_model
from synth.arguments import checked
from synth.errors import UserError
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.flow import open_flow_process
from synth.system import checked_file
from synth.system.terminal import counting

Settings = RecordingFlowSettings  # public name
_OUTPUT_BYTES = 32 << 20  # for score.json and report.html
_LONG = 100  # frames from which a second process is worth the seconds that it takes to start


@checked
def score(
    recording: str | Path | Recording,
    model: str | Path | Predictor | None = None,
    *,
    methods: Mapping[str, Method] | None = None,
    main: str | None = None,
    baselines: bool = True,
    settings: Settings | None = None,
    out: str | Path | None = None,
    title: str = "",
    progress: bool = False,
    own_process: bool = False,
) -> Result:
    """Scores a model, your own methods, or both, on a recording; writes files only with `out`.

    Args:
        recording: its folder, or the result of `open_recording`.
        model: from `learn.load_model`, its folder, or the name of a pretrained one; its name in the tables is
            D2FNet.
        methods: further methods by name.
        main: name of the method that the result is about; None: the model's, else the first of `methods`,
            else physics.
        baselines: whether physics and the plug-ins' methods are scored next to a model or methods.
        settings: flow back end, rate, masks; None: the command's defaults.
        out: folder for score.json and report.html, which are written together.
        title: heading of the report.
        progress: whether a progress bar is shown, in a terminal or a notebook.
        own_process: whether the flow of a long recording is computed in another process, which imports the
            main module again.

    Returns:
        The result: scores in `Result.methods[name].scores`, curves in `Result.time_s` and `.size_mn` of each.

    Raises:
        UserError: unusable recording, model or settings, or nothing to score; nothing is written.
    """
    if not isinstance(recording, Recording):
        recording = open_recording(Path(recording))
    if reserved := {FUSION, MAIN} & set(methods or {}):
        raise UserError(f"methods: the name {min(reserved)} is reserved; choose another")
    source = find_model(model) if isinstance(model, (str, Path)) else model
    network = None if source is None else Model(source)
    frames = len(recording.numbers) or None
    bar: AbstractContextManager[Progress]
    bar = counting(f"scoring {recording.name}", frames) if progress else nullcontext(lambda done: None)
    with ExitStack() as stack:
        if out is not None:
            stack.enter_context(checked_file.open_folder(Path(out), _OUTPUT_BYTES))
        flow, flow_settings = None, settings or Settings()
        # Another process is given an estimator by its name.
        if own_process and isinstance(flow_settings.backend, str) and (frames or _LONG) >= _LONG:
            flow = stack.enter_context(open_flow_process())
        selection = _choose_methods(network, methods or {}, baselines)
        first = next(iter(selection)) if main is None else main
        if first not in selection:
            raise UserError(f"main {first}: no such method; one of {', '.join(selection)}")
        description = _describe(selection)
        with bar as advance:
            result = evaluate_recording(
                recording, selection, first, recording.scale, flow_settings, description, advance, flow
            )
        if out is not None:
            write_result(result, Path(out), title)
    return result


def _choose_methods(
    network: Model | None, further: Mapping[str, Method], baselines: bool
) -> dict[str, Method]:
    """All methods by name, in the table's order."""
    selection: dict[str, Method] = {} if network is None else {MAIN: network}
    for name, method in further.items():
        selection[name] = method if isinstance(method, Model) else PluginMethod(method, f"method {name}")
    if baselines or not selection:
        baseline_methods = comparison.simpler_methods()
        selection |= {name: method for name, method in baseline_methods.items() if name not in selection}
    if network is not None and isinstance(selection.get(PHYSICS), Physics):
        selection[FUSION] = Fusion(MAIN, PHYSICS)
    return selection


def _describe(selection: Mapping[str, Method]) -> dict[str, Any]:
    """Hashes, origins and versions of the networks and plug-ins among the methods, for the report."""
    networks = {name: method for name, method in selection.items() if isinstance(method, Model)}
    origins = {name: {"hash": method.identity, "origin": method.origin} for name, method in networks.items()}
    main = networks.get(MAIN)
    if main is not None and FUSION in selection:
        origins[FUSION] = {"hash": f"{main.identity} and physics", "origin": main.origin}
    description: dict[str, Any] = {} if main is None else {"model": main.describe()}
    description["networks"] = origins
    sources = {
        name: method.source
        for name, method in selection.items()
        if isinstance(method, PluginMethod) and method.source
    }
    if sources:
        description["plug_ins"] = sources
    return description


def write_result(result: Result, folder: Path, title: str) -> None:
    """Writes score.json and report.html; neither has its name before both are complete."""
    with (
        checked_file.part_of(folder / "score.json") as scores,
        checked_file.part_of(folder / "report.html") as page,
    ):
        scores.write_text(json.dumps(as_json(result), indent=1, allow_nan=False) + "\n", "utf-8")
        page.write_text(score_report.render_report(result, title), "utf-8")
