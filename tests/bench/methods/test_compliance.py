"""Compliances by static condensation against direct solutions; bases on disk."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.methods import compliance, posterior
from bench.methods.compliance import TO_CAMERA, ElasticBlock, TissueKind, picture
from synth.fem.condensation import condense
from synth.fem.mesh import tetrahedra
from synth.fem.system import assemble

Floats = NDArray[np.float64]
TETS = 500


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Compliances of a coarse mesh, which are forgotten afterwards."""
    monkeypatch.setattr(compliance, "_TETS", TETS)
    monkeypatch.setattr(compliance, "SETTINGS", (1.0, 1.2, TETS))
    caches = compliance._condense, compliance._geometry, posterior.load_basis
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


def solve_directly(tissue: TissueKind, nodes: NDArray[np.intp]) -> Floats:
    """Columns of the compliance (3 P, 3 S), by the factor of the whole mesh."""
    block, lattice = ElasticBlock.build(TETS, tissue), compliance.lattice()
    observed_points, loaded_points = block.embed(lattice.points), block.embed(lattice.nodes)
    unit = np.einsum("kl,ab->kbal", np.eye(len(lattice.nodes))[:, nodes], TO_CAMERA)
    u = block.system.solve(loaded_points.gather(unit.reshape(len(lattice.nodes), 3, -1)))
    return picture(observed_points, u, 3).transpose(1, 0, 2).reshape(3 * len(lattice.points), -1)


@pytest.mark.parametrize(
    "tissue",
    [
        TissueKind("bonded", 0.0, 0.45),
        TissueKind("bonded", 40.0, 0.45),
        TissueKind("slipping", 250.0, 0.45, 1.02),
        TissueKind("free", 5.0, 0.49, 1.02),
    ],
)
def test_compliances_are_those_of_direct_solutions(coarse: None, tissue: TissueKind) -> None:
    nodes = np.arange(0, len(compliance.lattice().nodes), 25)
    direct = solve_directly(tissue, nodes)
    for components, alone in ((2, False), (3, False), (3, True)):
        matrix = compliance.solve(tissue, components, alone=alone)
        columns = matrix.reshape(len(matrix), 3, -1)[..., nodes].reshape(len(matrix), -1)
        # What surrounds the window is eliminated in single precision.
        np.testing.assert_allclose(columns, direct[: len(matrix)], atol=2e-6 * np.abs(direct).max(), rtol=0)
        assert np.linalg.norm(columns - direct[: len(matrix)]) < 1e-5 * np.linalg.norm(direct[: len(matrix)])


def test_a_condensed_mesh_moves_as_the_whole() -> None:
    volume = tetrahedra.block(300)
    system = assemble(volume, "linear", 0.45)
    rng = np.random.default_rng(0)
    master_nodes = rng.permutation(np.flatnonzero(~volume.fixed))[:40]
    inner = condense(system.stiffness, volume.points, volume.cells, master_nodes, volume.fixed)
    force = np.zeros_like(volume.points)
    force[master_nodes] = rng.normal(size=(40, 3))
    u = np.linalg.solve(inner, force[master_nodes].ravel())
    np.testing.assert_allclose(
        u, system.solve(force)[master_nodes].ravel(), rtol=0, atol=1e-9 * np.abs(u).max()
    )


def test_a_basis_is_computed_once_and_again_if_its_file_is_cut_off(
    coarse: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SULCUS_CACHE", str(tmp_path))
    posterior.cache.folder.cache_clear()
    calls, tissue = [], TissueKind("bonded", 40.0, 0.45)
    solve = compliance.solve
    monkeypatch.setattr(
        compliance, "solve", lambda *args, **options: calls.append(args) or solve(*args, **options)
    )
    first = posterior.load_basis(2, tissue)
    posterior.load_basis.cache_clear()
    second = posterior.load_basis(2, tissue)
    assert len(calls) == 1
    for name in ("motion", "size", "force", "omitted", "contacts", "loads"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    (file,) = tmp_path.rglob("*.npz")
    assert file.stat().st_size < 3e6
    file.write_bytes(file.read_bytes()[:1000])
    posterior.load_basis.cache_clear()
    posterior.load_basis(2, tissue)
    assert len(calls) == 2
    posterior.cache.folder.cache_clear()


def test_quadratic_forms_by_cofactors_are_those_of_the_inverse() -> None:
    rng = np.random.default_rng(3)
    half, vector = rng.normal(size=(5, 7, 3, 3)), rng.normal(size=(7, 3))
    matrix = half @ half.swapaxes(-1, -2) + 0.1 * np.eye(3)
    fit, log = posterior._quadratic(matrix, vector)
    np.testing.assert_allclose(fit, np.einsum("ha,shab,hb->sh", vector, np.linalg.inv(matrix), vector))
    np.testing.assert_allclose(log, np.linalg.slogdet(matrix)[1], atol=1e-9)
