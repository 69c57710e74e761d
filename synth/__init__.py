"""Synthesis of surgical-microscope sequences with exact physical ground truth."""

from importlib import import_module
from typing import Any

# Name -> where it is. Looked up when first asked for: importing this package loads nothing but this file.
# `__init__.pyi` says the same to type checkers; a test holds the two together.
_WHERE = {
    "Dataset": "synth.dataset.store",
    "Estimator": "synth.flow.estimator",
    "Frame": "synth.sequence.scene",
    "Job": "synth.job.schema",
    "Law": "synth.job.laws",
    "Scene": "synth.sequence.scene",
    "Sequence": "synth.dataset.store",
    "Summary": "synth.engine.run",
    "Track": "synth.flow.track",
    "UserError": "synth.errors",
    "add_law": "synth.job.laws",
    "load_job": "synth.job.reader",
    "open_sequence": "synth.dataset.store",
    "simulate": "synth.sequence.scene",
    "recover_flow": "synth.flow.track",
    "Camera": "synth.render.camera.camera",
    "Scenario": "synth.sequence.scenario",
    "ToolMotion": "synth.fem.tool_gesture",
    "draw_scenario": "synth.sequence.scenario",
    "open_dataset": "synth.engine.run",
    "write_scene": "synth.sequence.pipeline",
    "render_job": "synth.engine.run",
}

__all__ = list(_WHERE)


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'synth' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_WHERE[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
