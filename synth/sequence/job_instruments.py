"""The meshes of one's own instruments that a job names."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from synth.job.schema import FemSection
from synth.render.instrument import OwnMesh
from synth.render.instrument_file import PlacedFile, read_own_mesh


def read_job_instruments(fem: FemSection) -> Mapping[str, OwnMesh]:
    """Meshes of a job's own instruments, by name. UserError: one can't be read, or isn't an instrument's."""
    meshes = {
        name: read_own_mesh(PlacedFile(section.file, section.tip, section.axis, section.up, section.unit_mm))
        for name, section in fem.own_instruments.items()
    }
    return MappingProxyType(meshes)
