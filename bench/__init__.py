"""Scoring recordings and comparing methods."""

from importlib import import_module
from typing import Any

# Name -> where it is, looked up when first asked for; as in `synth`.
_WHERE = {
    "ForceEstimate": "bench.methods.protocol",
    "Method": "bench.methods.protocol",
    "MethodContext": "bench.methods.protocol",
    "Result": "bench.scoring.result",
    "Settings": "synth.recording_flow.video_flow:RecordingFlowSettings",
    "export_recording": "bench.recording.from_sequence",
    "score": "bench.scoring.score",
}
_OLD = {"Answer": "ForceEstimate", "Scene": "MethodContext"}
"""What plug-ins may still call them."""

__all__ = [*_WHERE]


def __getattr__(name: str) -> Any:
    if name in _OLD:
        return __getattr__(_OLD[name])
    if name not in _WHERE:
        raise AttributeError(f"module 'bench' has no attribute {name!r}")
    place, _, other_name = _WHERE[name].partition(":")
    value = globals()[name] = getattr(import_module(place), other_name or name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
