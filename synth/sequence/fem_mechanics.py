"""Mechanics of a sequence by our own finite elements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from synth.fem import solver
from synth.fem.deformation import Deformation
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.mesh_relief import HeightMap
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.tool_gesture import ToolMotion, check_motions
from synth.sequence.rest_scene import RestScene
from synth.system.recent import Recent
from synth.system.stopwatch import StageCallback, Stopwatch

# A brain that is loaded again in the same places keeps its mesh.
_VOLUMES = Recent[Tets](2, lambda tets: tets.points.nbytes + tets.cells.nbytes)


@dataclass(frozen=True)
class FemMechanics:
    """Finite elements in the volume under the surface, loaded by the scenario's gestures and pulse."""

    motions: Sequence[ToolMotion] = ()
    """Of the instruments, over T frames each; the gestures' own trajectories if there are none."""

    inside: bool = False
    """Whether to return the volume's motion and stress too."""

    def deform(self, rest: RestScene, report: StageCallback, watch: Stopwatch, /) -> Deformation:
        """As `Mechanics.deform`; raises as `solver.deform`, and UserError for a volume without a mesh."""
        motions = self.motions and check_motions(self.motions, rest.scenario.gestures, rest.job.frames)
        draw, case, job = rest.draw, rest.scenario, rest.job
        with watch.stage("mesh"):
            tets = build_volume(rest)
        report("fem", 0, 1)
        with watch.stage("fem"):
            return solver.deform(
                draw.scheme,
                case.tissue,
                case.gestures,
                tets,
                rest.shape,
                job.frames,
                job.fps,
                case.pulse,
                draw.opening_mm,
                motions,
                self.inside,
            )


def build_volume(rest: RestScene) -> Tets:
    """The volume under the surface, meshed finest under the contacts. UserError: it can't be meshed."""
    draw, surface, count = rest.draw, rest.surface, rest.job.fem.tets
    focus = tuple(place for gesture in rest.scenario.gestures for place in gesture.focus)
    slips, opening_mm = rest.scenario.tissue.skull == "slip", draw.opening_mm
    if (brain := rest.brain) is not None:
        mesh = partial(tetrahedra.from_brain, brain, count, focus, opening_mm=opening_mm, slips=slips)
        return _VOLUMES.get(mesh, brain, count, focus, opening_mm, slips)
    height = HeightMap(surface.pia, surface.extent_mm)
    width, length, depth = (draw.scale * side for side in tetrahedra.BLOCK_MM)
    block = partial(
        tetrahedra.block,
        count,
        focus,
        height,
        opening_mm=opening_mm,
        dome_mm=rest.job.anatomy.dome_mm,
        attachments=draw.attachments,
        slips=slips,
        size_mm=(width, length, depth),
    )
    return _VOLUMES.get(block, *block.args, *block.keywords.values())
