"""Material of the tissue and of the membrane on it."""

from __future__ import annotations

from dataclasses import dataclass

from synth.fem import ogden
from synth.fem.membrane import MembraneSheet
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import System, assemble
from synth.system.recent import Recent

# One brain loaded again, by another gesture, costs no factorisation; a fine mesh's is too large to keep.
_SYSTEMS = Recent[System](2, lambda system: 16 * system.factor.nnz)


@dataclass(frozen=True)
class Pia:
    """An intact membrane (the pia), as drawn for one sequence."""

    young_kpa: float  # Young's modulus at small strain
    thickness_mm: float
    stretch: float  # pre-stretch, at rest
    stiffening: float = 0.0  # as of `MembraneSheet`


@dataclass(frozen=True)
class Tissue:
    """Tissue of one sequence, as drawn."""

    young_kpa: float  # Young's modulus E
    poisson: float  # Poisson's ratio
    law: str  # material law, a key of `laws.NUMBER`, ogden or a plug-in's name
    why: str = "set by the job"  # reason for this law
    membrane: Pia | None = None  # on the surface; None where it is removed
    skull: str = "bonded"  # `bonded` or `slip`
    alpha: float = ogden.ALPHA  # exponent of Ogden's law

    def equations(self, tets: Tets) -> System:
        """The equations of a volume of this tissue."""
        pia, sheet = self.membrane, None
        if pia is not None:
            stiffness = pia.young_kpa * pia.thickness_mm / self.young_kpa
            sheet = MembraneSheet(stiffness, pia.stretch, pia.stiffening)
        parameters = self.law, self.poisson, sheet, self.alpha
        return _SYSTEMS.get(lambda: assemble(tets, *parameters), tets, parameters)
