"""Methods of other packages, found by their entry points and scored beside ours."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.methods.protocol import Field, ForceEstimate, Method, MethodContext, Revising, Uses3D
from synth.errors import UserError, as_user_error
from synth.plugins import Registry, check_answer

METHODS = Registry("sulcus.method", "method", "method", {})
"""Methods of other packages: an entry point is a callable without arguments that gives a `Method`."""

_MOST_MN = 1e12  # more is an error and no force


class Plugged:
    """A method of somebody else's; what goes wrong in it is one line that names it."""

    def __init__(self, method: Any, label: str) -> None:
        self._method, self._label = method, label
        if isinstance(method, Uses3D):
            self.in_space = partial(self._asked, method.in_space)
            """See `Uses3D`."""
        if isinstance(method, Revising):
            self.revise = self._revised
            """See `Revising`."""

    @property
    def notes(self) -> list[str]:
        """What it says is to be known of how it read the recording."""
        with as_user_error(self._label):
            return [str(note) for note in getattr(self._method, "notes", ())]

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`."""
        return self._asked(self._method, flow, confidence, scene, picture)

    def _revised(self, contact_free: NDArray[np.bool_]) -> list[ForceEstimate]:
        with as_user_error(self._label):
            answers = list(self._method.revise(contact_free.copy()))
            if len(answers) != len(contact_free):
                raise TypeError(f"revises {len(answers)} frames of {len(contact_free)}")
        return [self._checked(one, None) for one in answers]

    def _asked(self, ask: Any, *told: Any) -> ForceEstimate:
        with as_user_error(self._label):
            answer = ask(*copy.deepcopy(told[:-2]), *told[-2:])  # the next method sees what it saw
        return self._checked(answer, told[0].shape[:2])

    def _checked(self, answer: Any, size: tuple[int, ...] | None) -> ForceEstimate:
        """`size`: of the pictures that it may give a density on; None: of none."""
        density = None
        with as_user_error(self._label):
            if not isinstance(answer, ForceEstimate):
                raise TypeError(f"answers {type(answer).__name__}, expected ForceEstimate")
            force = np.asarray(answer.force_mn, np.float64)
        if force.shape != (3,):
            raise UserError(f"{self._label}: gives force of shape {force.shape}, expected (3,)")
        if (np.abs(force) > _MOST_MN).any() or answer.low_mn > answer.high_mn:
            size_mn = f"force {force.tolist()} mN in [{answer.low_mn:g}, {answer.high_mn:g}]"
            raise UserError(f"{self._label}: gives {size_mn}, which can't be")
        if answer.density is not None and size is not None:
            density = check_answer(self._label, "density", answer.density, size)
        return replace(answer, force_mn=force, density=density)


def installed() -> dict[str, Method]:
    """The methods that installed packages offer, made anew, by name.

    Raises:
        UserError: one does not load, or is no callable.
    """
    return {name: _load(name) for name in METHODS.names()}


def sources() -> dict[str, str]:
    """Package and version that each plug-in's method comes from."""
    return {name: METHODS.source(name) for name in METHODS.names()}


def _load(name: str) -> Method:
    method = METHODS.load(name)
    if not callable(method):
        raise UserError(f"{METHODS.label(name)}: is no method, it cannot be called")
    return Plugged(method, METHODS.label(name))
