"""Plug-ins of other packages by name, found by entry points: estimators, laws, networks, formats, methods."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from synth.errors import InvalidValue, UserError, as_user_error, did_you_mean

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

STORED = object()
"""Validation context of a stored job: reading a dataset needs none of the plug-ins that created it."""


def check_answer(
    label: str,
    quantity: str,
    answer: Any,
    shape: tuple[int, ...],
    limits: tuple[float, float] = (-3e38, 3e38),
) -> NDArray[np.float32]:
    """An array from a plug-in or a caller, as (...) float32 of that shape and within limits.

    UserError that begins with `label` and `quantity` for anything else.
    """
    import numpy as np  # here: command lines list plug-ins in their help

    with as_user_error(f"{label}: {quantity}"):
        array = np.asarray(answer, np.float32)
        if array.shape != shape:
            raise InvalidValue(f"shape {array.shape}, expected {shape}")
        low, high = float(array.min(initial=0)), float(array.max(initial=0))
        if not (limits[0] <= low and high <= limits[1]):  # also for NaN
            raise InvalidValue(f"from {low:g} to {high:g}, expected {limits[0]:g} to {limits[1]:g}")
    return array


class Registry:
    """Plug-ins of one kind by name: built-in ones, those passed to `add`, and those of installed packages."""

    def __init__(self, group: str, key: str, noun: str, builtin: Mapping[str, str], *further: str) -> None:
        """`group`: of entry points; `key`: of the job, with `further` values; `noun`: the kind, for messages.

        `builtin`: they take precedence, as `module:attribute`, empty if there is nothing to load.
        """
        self.group, self.builtin = group, builtin
        self._key, self._noun, self._further = key, noun, further
        self._added: dict[str, Any] = {}

    def names(self) -> tuple[str, ...]:
        """All names: the built-in ones, then the others in order."""
        return (*self.builtin, *sorted({*self._points(), *self._added} - set(self.builtin)))

    def check_name(self, name: str, info: Any) -> str:
        """Returns `name` if it is known or `info.context` is STORED, else raises InvalidValue."""
        # Every job passes here: listing the installed packages takes 12 ms, so it comes last.
        if name in self.builtin or name in self._further or info.context is STORED:
            return name
        known = (*self._further, *self.names())
        if name not in known:
            hint = did_you_mean(name, known)
            raise InvalidValue(f"there is no {self._noun} {name!r}; there are {', '.join(known)}{hint}")
        return name

    def add(self, name: str, plugin: Any) -> None:
        """Registers a plug-in in this process. UserError if the name is taken."""
        if name in self.names():
            raise UserError(f"{self._key}: the name {name!r} is taken")
        self._added[name] = plugin

    def source(self, name: str) -> str:
        """Name and version of the package that a plug-in comes from; empty for built-in and added ones."""
        point = None if name in self.builtin else self._points().get(name)
        return f"{point.dist.name} {point.dist.version}" if point and point.dist else ""

    def label(self, name: str) -> str:
        """The plug-in's name in messages: `fem.law my-law (package.module:Law)`."""
        origin = "" if name in self._added else f" ({self._point(name).value})"
        return f"{self._key} {name}{origin}"

    def load(self, name: str) -> Any:
        """The object registered under `name`; that of an entry point is called without arguments if callable.

        UserError: there is none, or any exception of its package.
        """
        plugin = self.load_as_is(name)
        if name in self._added or not callable(plugin):
            return plugin
        with as_user_error(self.label(name)):
            return plugin()

    def load_as_is(self, name: str) -> Any:
        """The object registered under `name` itself, not called. UserError as `load`."""
        if name in self._added:
            return self._added[name]
        if name in self.builtin:  # a library that it lacks is reported by the caller
            return self._point(name).load()
        with as_user_error(self.label(name)):
            return self._point(name).load()

    def _points(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def _point(self, name: str) -> EntryPoint:
        if name in self.builtin:
            return EntryPoint(name, self.builtin[name], self.group)
        if name not in (points := self._points()):
            raise UserError(f"{self._key}: no {self._noun} {name!r}; there are {', '.join(self.names())}")
        return points[name]


_BUILTIN = {"tvl1": "tvl1:Tvl1", "opencv-tvl1": "opencv:OpenCvTvl1", "dis": "opencv:Dis"}
_MODULES = {name: f"synth.flow.{place}" for name, place in _BUILTIN.items()}
ESTIMATORS = Registry("sulcus.flow", "flow.backend", "estimator", _MODULES, "ideal")
"""Flow estimators: an entry point is a callable without arguments that returns a `synth.Estimator`."""
