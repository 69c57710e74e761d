"""Methods of other packages, found by their entry points and scored beside ours."""

from __future__ import annotations

from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.methods.protocol import Answer, InSpace, Method, Scene
from synth.errors import UserError

GROUP = "sulcus.method"
"""Entry-point group in which other packages offer methods: name -> a callable without arguments."""


class Plugged:
    """A method of another package; what goes wrong in it is one line that names it."""

    def __init__(self, name: str, point: EntryPoint, method: Any) -> None:
        self._method, self._where = method, f"method {name} ({point.value})"
        if isinstance(method, InSpace):
            self.in_space = partial(self._asked, method.in_space)
            """See `InSpace`."""

    @property
    def notes(self) -> list[str]:
        """What it says is to be known of how it read the recording."""
        return [str(note) for note in getattr(self._method, "notes", ())]

    def __call__(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32], scene: Scene, picture: bool
    ) -> Answer:
        """See `Method`."""
        return self._asked(self._method, flow, confidence, scene, picture)

    def _asked(self, ask: Any, *told: Any) -> Answer:
        try:
            answer = ask(*told)
            force = np.asarray(answer.force_mn, np.float64)
            density = None if answer.density is None else np.asarray(answer.density, np.float32)
        except Exception as error:  # whatever a package of others raises
            said = (str(error).splitlines() or [""])[0][:200]
            raise UserError(f"{self._where}: {type(error).__name__}: {said}") from error
        if force.shape != (3,):
            raise UserError(f"{self._where}: gives force of shape {force.shape}, expected (3,)")
        if density is not None and density.shape != told[0].shape[:2]:
            raise UserError(f"{self._where}: gives density of shape {density.shape}, not the picture's")
        return Answer(force, density)


def installed() -> dict[str, Method]:
    """The methods that installed packages offer, made anew, by name.

    Raises:
        UserError: one does not load, or is no callable.
    """
    return {point.name: _made(point) for point in sorted(entry_points(group=GROUP))}


def sources() -> dict[str, str]:
    """Package and version that each plug-in's method comes from."""
    found = {point.name: point.dist for point in entry_points(group=GROUP)}
    return {name: f"{dist.name} {dist.version}" if dist else "" for name, dist in sorted(found.items())}


def _made(point: EntryPoint) -> Method:
    try:
        method = point.load()()
    except Exception as error:  # whatever a package of others raises
        said = (str(error).splitlines() or [""])[0][:200]
        where = f"method {point.name} ({point.value})"
        raise UserError(f"{where}: cannot be made, {type(error).__name__}: {said}") from error
    if not callable(method):
        raise UserError(f"method {point.name} ({point.value}): is no method, it cannot be called")
    return Plugged(point.name, point, method)
