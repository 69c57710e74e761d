"""Pictures and their truth: one surface under the microscope, moved frame by frame."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    """A module that can be called: scripts type `synth.render(job, out)`, and this room has that name.

    A function of that name in the package would be overwritten as soon as a module of this room is imported.
    """

    def __call__(self, *args: Any, **named: Any) -> Any:
        """`synth.engine.render.render`, found when called: this room knows nothing of the engine."""
        return import_module("synth.engine.render").render(*args, **named)


sys.modules[__name__].__class__ = _Callable
