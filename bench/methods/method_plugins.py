"""Methods of other packages, found by their entry points and scored next to ours."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np

from bench.methods.method_interface import ForceEstimate, FrameMotion, Method, MethodContext, Revising
from synth.arrays import Mask
from synth.errors import UserError, as_user_error
from synth.plugins import Registry, check_answer

# An entry point is a callable without arguments that returns a `Method`.
METHODS = Registry("sulcus.method", "method", "method", {})

_MOST_MN = 1e12  # larger forces are errors


class PluginMethod:
    """A method of another package or script; its errors become one line that names it."""

    def __init__(self, method: Any, label: str, source: str = "") -> None:
        """`label`: for messages; `source`: package and version of a plug-in."""
        self._method, self._label, self.source = method, label, source
        if isinstance(method, Revising):  # set only then, so that this is one too
            self.revise = self._revise

    @property
    def notes(self) -> list[str]:
        """The method's notes on the recording."""
        with as_user_error(self._label):
            return [str(note) for note in getattr(self._method, "notes", ())]

    @property
    def is_elastic(self) -> bool:
        """Whether the method takes the tissue for elastic; see `Method`."""
        return bool(getattr(self._method, "is_elastic", False))

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`."""
        with as_user_error(self._label):
            # A copy, so that a method that writes to its input does not change that of the next.
            estimate = self._method(copy.deepcopy(frame), scene, picture)
        return self._check(estimate, frame.confidence.shape)

    def _revise(self, contact_free: Mask) -> list[ForceEstimate]:
        with as_user_error(self._label):
            estimates = list(self._method.revise(contact_free.copy()))
            if len(estimates) != len(contact_free):
                raise TypeError(f"revises {len(estimates)} frames of {len(contact_free)}")
        return [self._check(estimate, None) for estimate in estimates]

    def _check(self, estimate: Any, size: tuple[int, ...] | None) -> ForceEstimate:
        """`size`: height and width that a density must have; None: a density is dropped."""
        density = None
        with as_user_error(self._label):
            if not isinstance(estimate, ForceEstimate):
                raise TypeError(f"returned {type(estimate).__name__}, expected ForceEstimate")
            force = np.asarray(estimate.force_mn, np.float64)
        if force.shape != (3,):
            raise UserError(f"{self._label}: returned force of shape {force.shape}, expected (3,)")
        if (np.abs(force) > _MOST_MN).any() or estimate.low_mn > estimate.high_mn:
            interval = f"[{estimate.low_mn:g}, {estimate.high_mn:g}]"
            raise UserError(f"{self._label}: returned the impossible force {force.tolist()} mN in {interval}")
        if estimate.density is not None and size is not None:
            density = check_answer(self._label, "density", estimate.density, size)
        return replace(estimate, force_mn=force, density=density)


def list_installed() -> dict[str, Method]:
    """New methods of installed packages, by name. UserError if one can't be loaded or called."""
    methods: dict[str, Method] = {}
    for name in METHODS.names():
        method, label = METHODS.load(name), METHODS.label(name)
        if not callable(method):
            raise UserError(f"{label}: not a method, it can't be called")
        methods[name] = PluginMethod(method, label, METHODS.source(name))
    return methods
