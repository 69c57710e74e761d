"""The network that comes along, trained further on sequences that look like one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.adaptation.specimen_job import specimen_job
from bench.recording.folder import Recording
from learn.checkpoint import ModelCard, read_model, room_needed
from learn.data.clips import Clip, load_clips, scored, sources
from learn.evaluation.fit_intervals import add_intervals, predict_clip
from learn.inference.predict import Predictor, load_model
from learn.inference.shipped import find_model, find_name, require_model
from learn.settings import replace
from learn.training.sides import divide
from learn.training.train import train
from synth.engine.journal import Watcher
from synth.engine.run import Options, run_job
from synth.errors import UserError
from synth.system.checked_file import made_folder, make_folder, write_whole
from synth.system.terminal import ProgressCallback

SEQUENCES = 200
EPOCHS = 12
LEARNING_RATE = 5e-4
"""A quarter of what the networks that come along began with: they are moved, not learnt anew."""


@dataclass(frozen=True)
class Adapted:
    """What came of it."""

    card: ModelCard
    before: float
    """Mean error of the whole force over its peak, on sequences left for the test, of the network that it
    began with."""
    after: float
    """Of the adapted one."""
    tested: int
    """Sequences."""


def adapt(
    recording: Recording,
    out: Path,
    model: Path | None = None,
    *,
    data: Path | None = None,
    sequences: int = SEQUENCES,
    watcher: Watcher | None = None,
    report: ProgressCallback = lambda done, of: None,
) -> Adapted:
    """Renders sequences that wear the recording's rest frame and trains a network further on them.

    No value of its force sensor is read. Called again it goes on where it was ended.

    Args:
        recording: what the network is for.
        out: folder for the model, and `out`/README.md that says what it is.
        model: to begin with; None: what comes along for so many eyes.
        data: folder of the rendered dataset; None: `out`-data. It may be deleted afterwards.
        sequences: to render.
        watcher: told of the rendering.
        report: told of the training.

    Raises:
        UserError: a recording without a usable rest frame, a model that can't be used, rendering that fails.
    """
    folder = require_model(recording.has_two_eyes) if model is None else find_model(model)
    net, began = read_model(folder)
    data = out.with_name(f"{out.name}-data") if data is None else data
    make_folder(data)
    job = specimen_job(recording, sequences, data / "rest.png")
    failed = run_job(job, data / "sequences", Options(), watcher or Watcher()).failed
    if len(failed) > sequences // 10:
        raise UserError(f"{data}: {len(failed)} of {sequences} sequences failed; see `synth status`")
    settings = replace(
        began.settings, epochs=EPOCHS, learning_rate=LEARNING_RATE, schedule="cosine", epoch_frames=0
    )
    with made_folder(out, room_needed(out, settings.arch)):
        wanted = sources(settings.input)
        clips = load_clips(data / "sequences", settings.grid, wanted, cache=data / "clips")
        clips, split = divide(clips, [data / "sequences"], settings.seed)
        card = train(clips, split, settings, out, start=(began, net.state_dict()), report=report)
    if card.intervals is None:
        card = add_intervals(out, load_model(out), clips, split)
    tested = [clips[i] for i in split.test]
    errors = [_error(load_model(one), tested, scored(settings.input)) for one in (folder, out)]
    found = Adapted(card, errors[0], errors[1], len(tested))
    write_whole(out / "README.md", _readme(recording, find_name(began) or str(folder), found))
    return found


def _error(predictor: Predictor, clips: Sequence[Clip], source: str) -> float:
    """Mean over sequences of the mean error of the whole force over its peak."""
    shares = []
    for clip in clips:
        true = clip.force / clip.young_kpa
        peak = float(np.linalg.norm(true, axis=1).max())
        if peak > 0:
            off = np.linalg.norm(predict_clip(predictor, clip, source).force - true, axis=1)
            shares.append(off.mean() / peak)
    if not shares:
        raise UserError("no sequence with a force is left for the test: render more of them")
    return float(np.mean(shares))


def _readme(recording: Recording, began: str, found: Adapted) -> str:
    fitted = len(found.card.split["fit"])
    specimen = recording.meta.specimen or recording.name
    return f"""# {began}, adapted to {specimen}

Trained further on rendered sequences that wear the rest frame of {recording.name}. No value of its force
sensor was read.

| what | |
| --- | --- |
| error of the force over its peak, {found.tested} such sequences it never met, before | {found.before:.1%} |
| after | {found.after:.1%} |
| sequences that either fitting met | {fitted} |

For this specimen under this camera alone: of another one it may say less than {began} does.
"""
