"""Learning force maps from displacement."""

from importlib import import_module
from typing import Any

# Name -> where it is, looked up when first asked for; as in `synth`.
_WHERE = {
    "ForceMap": "learn.inference.predict",
    "Predictor": "learn.inference.predict",
    "load_model": "learn.inference.predict",
    "predict_force": "learn.inference.force_reader",
}

__all__ = [*_WHERE]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'learn' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_WHERE[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
