"""The seam of mechanics: what moves the surface of a scene, ours or another engine's."""

from __future__ import annotations

from typing import Protocol

from synth.fem.deformation import Deformation
from synth.sequence.rest_scene import RestScene
from synth.system.stopwatch import StageCallback, Stopwatch


class Mechanics(Protocol):
    """Mechanics of a sequence, from its scene at rest to motion and load of its surface.

    `simulate` uses `FemMechanics` unless it is given another.
    """

    def deform(self, rest: RestScene, report: StageCallback, watch: Stopwatch, /) -> Deformation:
        """Deformation of a scene.

        Args:
            rest: the scene. Its `shape` has the V vertices whose motion is wanted, in world axes: mm, z out
                of the brain, origin at the craniotomy's centre; `brain.to_world` takes a user's mesh to them.
                `scenario` has tissue, pulse and gestures, which are stored as the sequence's own: a method
                that differs from them is given a scenario that states what it does (`case` of `simulate`).
            report: called with progress: name of a stage, steps done, steps in all.
            watch: adds up the time of stages that the method names.

        Returns:
            All arrays of `Deformation` but those that may be None, over `rest.job.frames` frames at
            `rest.time`, with as many instruments as the scenario has gestures. Traction is that on the
            tissue; nodal forces over `rest.vertex_area` give it. `check_deformation` states what is refused.

        Raises:
            UserError: the scene can't be deformed.
        """
        ...
