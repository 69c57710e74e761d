"""Series of other programs: every format gives the same states, whatever can't be used is refused by name."""

import base64
import json
import os
import re
import resource
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pressed_block
import pytest
import trimesh
from pressed_block import STATES, STEP_S, solve, write
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from synth.arrays import Floats, Ints
from synth.errors import UserError
from synth.fem.external import plausibility
from synth.fem.external.plausibility import contact_radius, is_rigid
from synth.fem.external.read_series import doubt_load, read_series
from synth.fem.external.series import MeshSeries, Units
from synth.geometry.mesh_file import SURFACES, read_mesh, read_surface
from synth.geometry.skin import skin

FORMS = ("ascii", "binary", "vtk", "moving", "npz", "points")
FORCE = "nodal:contact"
TABLE = "time,fx,fy,fz,x,y,z\n0,0,0,0,1,0,0\n0.2,1.5,0,-4,1,0,0\n0.5,0,0,0,1,0,0\n"


@contextmanager
def limit_memory(extra_bytes: int) -> Iterator[None]:
    """Memory that the process may take beyond what it has [bytes]."""
    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    old_limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + extra_bytes, old_limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, old_limits)


def glb(tree: dict[str, Any]) -> bytes:
    """A .glb of this JSON, without binary data."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = np.array([2, 20 + len(text), len(text)], "<u4").tobytes()
    return b"glTF" + head + b"JSON" + text


def read(source: Path, mm: float = 1.0, mn: float = 1.0, force: str | None = FORCE) -> MeshSeries:
    return read_series(source, Units(mm, mn, STEP_S), force)


def order_arrays(series: MeshSeries) -> list[Floats]:
    """Points at rest, and displacement and force of the third state, in an order that all formats share."""
    assert series.force is not None
    order = np.lexsort(series.points.round(3).T)
    return [series.points[order], series.displacement[2][order], series.force[2][order]]


def test_sofas_recorder_on_the_page_writes_a_series(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's controller with stand-ins for SOFA's objects, which hold the block's states one by one."""
    page = Path(__file__).parents[4] / "docs" / "howto" / "mechanics.md"
    (code,) = re.findall(r'title="record_sofa.py"\n(.*?)```', page.read_text("utf-8"), re.S)
    sofa, core = ModuleType("Sofa"), ModuleType("Sofa.Core")
    core.Controller = type("Controller", (), {"__init__": lambda self, **words: None})  # type: ignore[attr-defined]
    sofa.Core = core  # type: ignore[attr-defined]
    for module in (sofa, core):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    namespace, (mm, mn) = dict[str, Any](), (1000.0, 1000.0)
    exec(code, namespace)
    block = solve()
    fields = {"lambda": SimpleNamespace(value=np.zeros((0, 3)))}
    tissue = SimpleNamespace(position=SimpleNamespace(value=block.points / mm), getData=fields.__getitem__)
    root = SimpleNamespace(time=SimpleNamespace(value=0.0))
    solver = SimpleNamespace(constraintForces=SimpleNamespace(value=[]))
    recorder = namespace["Recorder"](root, solver, tissue, block.tets)
    for k, scale in enumerate(block.scale[1:], 1):
        root.time.value, in_contact = STEP_S * k, scale > 0
        tissue.position.value = (block.points + scale * block.u) / mm
        solver.constraintForces.value = [1.0] if in_contact else []
        fields["lambda"].value = scale * block.force / mn if in_contact else np.zeros((0, 3))
        recorder.onAnimateEndEvent(None)
    recorder.save(tmp_path / "press.npz")
    series, expected = (
        read(tmp_path / "press.npz", mm, mn),
        read(write(tmp_path / "s", "points", mm, mn), mm, mn),
    )
    assert series.time == pytest.approx(expected.time)
    for array, expected_array in zip(order_arrays(series), order_arrays(expected), strict=True):
        np.testing.assert_allclose(array, expected_array, atol=1e-6 * np.abs(expected_array).max())


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("mm", "mn"), [(1.0, 1.0), (1000.0, 1000.0)])
def test_every_format_and_unit_gives_the_same_states(form: str, mm: float, mn: float, tmp_path: Path) -> None:
    block, series = solve(), read(write(tmp_path / "s", form, mm, mn), mm, mn)
    assert series.time == pytest.approx(STEP_S * np.arange(STATES))
    boundary = np.isclose(np.abs(block.points - [0, 0, -9]), [24, 24, 9]).any(axis=1)
    order = np.flatnonzero(boundary)[np.lexsort(block.points[boundary].round(3).T)]
    for values, expected in zip(order_arrays(series), (block.points, block.u, block.force), strict=True):
        np.testing.assert_allclose(values, expected[order], atol=3e-6 * np.abs(expected).max())
    assert series.force is not None
    np.testing.assert_allclose(series.force[2].sum(axis=0), -block.reaction, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        series.at(0.15, "displacement"), series.displacement[1:3].mean(axis=0), atol=1e-6
    )


def test_a_run_of_the_published_recorder_gives_the_total_force(tmp_path: Path) -> None:
    """It stores neither faces nor indices, and forces scaled so that their peak is the total."""
    source = write(tmp_path / "run_E1_nu0.4_seed1", "recorder")
    series = read_series(source, Units(), "nodal:surface_external_forces")
    assert series.force is not None
    np.testing.assert_allclose(series.force[2].sum(axis=0), -solve().reaction, rtol=1e-5, atol=1e-5)
    assert np.isclose(series.points[:, 2], 0).all()


def test_a_table_gives_the_total_force_at_its_place(tmp_path: Path) -> None:
    source = write(tmp_path, "ascii")
    (tmp_path / "force.csv").write_text(TABLE)
    force = read(source, force="force.csv").force
    assert force is not None
    np.testing.assert_allclose(
        force.sum(axis=1)[[1, 2, 3]], [[0.75, 0, -2], [1.5, 0, -4], [1, 0, -8 / 3]], rtol=1e-5
    )
    points = read(source).points
    assert np.linalg.norm(points[np.abs(force[2]).sum(axis=1) > 0] - [1, 0, 0], axis=1).max() < 4


def test_traction_is_force_over_the_area_at_rest(tmp_path: Path) -> None:
    for mm in (1.0, 1000.0):
        source = write(tmp_path / str(mm), "npz", mm)
        with np.load(source) as file:
            arrays = dict(file)
        pressure = np.where(
            np.isclose(arrays["rest"][:, 2:], 0), [0, 0, -0.5 * mm**2], 0
        )  # mN per unit of area
        arrays["contact"] = np.multiply.outer(solve().scale, pressure)
        np.savez(source, **arrays)
        force = read(source, mm, force="traction:contact").force
        assert force is not None
        # The nodes on the block's edges also bear on their sides.
        assert force[2].sum(axis=0)[2] == pytest.approx(-0.5 * 48**2, rel=0.13)


def test_coincident_nodes_count_once_and_their_loads_add_up(tmp_path: Path) -> None:
    block, source = solve(), write(tmp_path, "npz")
    with np.load(source) as file:
        arrays = dict(file)
    corner_nodes = block.tets.ravel()  # a node for each corner of each cell, as discontinuous elements have
    share = 1 / np.bincount(corner_nodes)[corner_nodes]
    arrays |= {"rest": arrays["rest"][corner_nodes], "displacement": arrays["displacement"][:, corner_nodes]}
    arrays |= {"contact": arrays["contact"][:, corner_nodes] * share[:, None]}
    np.savez(tmp_path / "t.npz", **arrays | {"tetrahedra": np.arange(corner_nodes.size).reshape(-1, 4)})
    for values, expected in zip(
        order_arrays(read(tmp_path / "t.npz")), order_arrays(read(source)), strict=True
    ):
        np.testing.assert_allclose(values, expected, atol=1e-6)


def change(name: str, old: str, new: str, form: str = "ascii") -> Callable[[Path], Path]:
    """A series with the first match of a pattern in one of its files replaced."""

    def write_series(folder: Path) -> Path:
        source, file = write(folder, form), folder / name
        text = file.read_text("latin-1")
        assert re.search(old, text, re.DOTALL)
        file.write_text(re.sub(old, new, text, count=1, flags=re.DOTALL), "latin-1")
        return source

    return write_series


def edit(**changes: Callable[[Floats], Floats] | None) -> Callable[[Path], Path]:
    """An .npz with arrays changed, or left out."""

    def write_series(folder: Path) -> Path:
        source = write(folder, "npz")
        with np.load(source) as file:
            contents = dict(file)
        for name, function in changes.items():
            value = contents.pop(name)
            contents |= {} if function is None else {name: function(value)}
        np.savez(source, **contents)
        return source

    return write_series


def omit_file(name: str, form: str) -> Callable[[Path], Path]:
    def write_series(folder: Path) -> Path:
        source = write(folder, form)
        (folder / name).unlink()
        return source

    return write_series


def remesh_state(folder: Path) -> Path:
    source = write(folder, "ascii")
    block = solve(4.0)
    fields = {"displacement": block.u, "contact": block.force}
    (folder / "block_2.vtu").write_text(pressed_block.ascii_vtu(block.points, block.tets, fields))
    return source


def write_two_series(folder: Path) -> Path:
    write(folder, "ascii")
    (folder / "tool_0.vtu").write_bytes((folder / "block_0.vtu").read_bytes())
    return folder


def remove_middle(tets: Ints) -> Ints:
    """Without the cells in the middle."""
    return tets[solve().points[tets][..., 0].mean(axis=1) ** 2 > 25]


def keep_first(values: Floats) -> Floats:
    return values[:1]


def drop_rows(values: Floats) -> Floats:
    return values[:0]


def drop_columns(values: Floats) -> Floats:
    return values[:, :0]


def make_rigid(values: Floats) -> Floats:
    """A press of 1 mm without a deformation."""
    return 0 * values + np.outer(solve().scale, [0, 0, -1])[:, None]


def set_value(k: int, value: float) -> Callable[[Floats], Floats]:
    def put(values: Floats) -> Floats:
        values = values.astype(float)
        values[k, 0, 0] = value
        return values

    return put


BAD: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "a file is missing in the middle": (r"block_1\.vtu.*block_3\.vtu", omit_file("block_2.vtu", "ascii")),
    "a listed file is missing": (r"block_2\.vtu", omit_file("block_2.vtu", "binary")),
    "not a number": (r"s\.npz", edit(displacement=set_value(2, np.nan))),
    "infinite force": (r"s\.npz", edit(contact=set_value(2, np.inf))),
    "not a number at rest": (r"s\.npz", edit(rest=lambda x: np.where(x == x[0], np.nan, x))),
    "remeshed": (r"block_2\.vtu", remesh_state),
    "lines only": (r"block_0\.vtu", change("block_0.vtu", r"(types.*?>)[\d ]+", r"\g<1>" + "3 " * 10**4)),
    "no such field": (r"contact.*displacement", change("block_0.vtu", 'Name="contact"', 'Name="lambda"')),
    "field lost later": (r"block_3\.vtu", change("block_3.vtu", 'Name="contact"', 'Name="lambda"')),
    "nothing moves": (r"stress.*displacement", change("block_0.vtu", 'Name="displacement"', 'Name="stress"')),
    "truncated XML": (r"block_1\.vtu", change("block_1.vtu", "</Cells>.*", "")),
    "truncated base64": (r"block_1\.vtu", change("block_1.vtu", r"(y\">\s*.{400}).*?<", r"\1<", "binary")),
    "a word among numbers": (r"block_1\.vtu", change("block_1.vtu", r"(Points.*?>)\S+", r"\1abc")),
    "cells without points": (r"block_0\.vtu", change("block_0.vtu", r"(connectivity.*?>)\d+", r"\g<1>99999")),
    "empty file": (r"block_3\.vtu", change("block_3.vtu", ".*", "")),
    "other type": (r"block_0\.vtu", change("block_0.vtu", "UnstructuredGrid", "ImageData")),
    "other kind of cells": (r"42", change("block_0.vtu", r"(types.*?>)10", r"\g<1>42")),
    "loaded at first": (r"s\.npz", edit(contact=lambda f: f + f[2])),
    "displaced at first": (r"s\.npz", edit(displacement=lambda u: u + u[2])),
    "net force": (r"net force", edit(contact=lambda f: f * ([0, 1, 0, 1, 0] @ np.eye(5))[:, None, None])),
    "no force at all": (r"0 mN", edit(contact=np.zeros_like)),
    "times run back": (r"block_3\.vtu", change("block.pvd", r'"0\.3\d*"', '"0.1"', "binary")),
    "times missing": (r"s\.npz", edit(times=lambda t: np.zeros_like(t))),
    "metres as millimetres": (r"1000 for m", edit(rest=lambda x: x / 1e3, displacement=lambda u: u / 1e3)),
    "mixed units": (r"s\.npz.*unit_mm", edit(displacement=lambda u: u / 1e5)),
    "several series": (r"block_\*\.vtu, tool_\*\.vtu", write_two_series),
    "one state": (r"s\.npz", edit(displacement=keep_first, contact=keep_first, times=keep_first)),
    "no cells": (r"s\.npz", edit(tetrahedra=None)),
    "shapes differ": (r"\(5, .*\(4,", edit(times=lambda t: t[:4])),
    "one number of time": (r"s\.npz", edit(times=lambda t: t[0])),
    "one number of motion": (r"s\.npz", edit(displacement=lambda u: u[0, 0, 0])),
    "one number of motion without times": (
        r"s\.npz", edit(displacement=lambda u: u[0, 0, 0], times=None),
    ),
    "duplicate nodes that part": (r"s\.npz", edit(rest=lambda x: np.where(x == x[7], x[8], x))),
    "separate bodies": (r"2 separate", edit(tetrahedra=remove_middle)),
    "a collection of nothing": (r"block\.pvd", change("block.pvd", "<DataSet.*/>", "", "binary")),
    "a file outside": (r"\.\./b", change("block.pvd", 'file="b', 'file="../b', "binary")),
    "motion of a wrong unit": ("times the width", edit(displacement=lambda u: 1000 * u)),
    "motion of 1e30 mm": (r"s\.npz", edit(displacement=set_value(2, 1e30))),
    "forces of 1e300 mN": (r"s\.npz", edit(contact=lambda f: 1e300 * f)),
    "a rigid motion with a force": ("rigid", edit(displacement=make_rigid)),
    "a zero state midway": ("state 2", edit(displacement=lambda u: u * (np.arange(5) != 2)[:, None, None])),
    "faces that are not whole": ("whole", edit(tetrahedra=lambda t: t + 0.5)),
    "an infinite last time": ("inf", edit(times=lambda t: np.append(t[:-1], np.inf))),
    "times of 1e308 s": ("308", edit(times=lambda t: np.array([-1.7e308, 0, 1, 2, 1.7e308]))),
    "no points": (r"s\.npz", edit(rest=drop_rows, displacement=drop_columns, contact=drop_columns)),
    "another engine's format": (r"\.frd.*VTU", lambda folder: folder / "block.frd"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_series_is_refused_in_one_line_that_names_it(case: str, tmp_path: Path) -> None:
    pattern, write_case = BAD[case]
    source = write_case(tmp_path)
    with pytest.raises(UserError, match=pattern) as error:
        read(source)
    assert "\n" not in str(error.value)


def find_doubts(source: Path, young_kpa: float | None = 1.0) -> list[str]:
    """All that is doubtful in a series."""
    series = read(source)
    return [*series.cautions, *doubt_load(series, young_kpa)]


def exchange(state: int, *nodes: int) -> Callable[[Floats], Floats]:
    """Displacement in which nodes take each other's places in a state."""

    def put(u: Floats) -> Floats:
        points = solve().points[list(nodes)]
        u[state, nodes] = np.roll(points + u[state, nodes], 1, axis=0) - points
        return u

    return put


def find_nearest(*place: float) -> int:
    return int(np.linalg.norm(solve().points - place, axis=1).argmin())


MIDDLE = find_nearest(0, 0, 0)

DOUBTFUL: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "newtons taken for millinewtons": (r"P = 4\.1e\+02.*", edit(contact=lambda f: 1000 * f)),
    "millinewtons taken for newtons": (r"P = 0\.00041", edit(contact=lambda f: f / 1000)),
    "reaction instead of load": ("negative work", edit(contact=lambda f: -f)),
    "y and z of the load swapped": ("80 degrees", edit(contact=lambda f: f[..., [0, 2, 1]])),
    "y and z of the motion swapped": ("80 degrees", edit(displacement=lambda u: u[..., [0, 2, 1]])),
    "load on other nodes": ("don't move", edit(contact=lambda f: f[:, ::-1])),
    "load a state late": ("state 4", edit(contact=lambda f: np.stack([0 * f[0], *f[:3], f[1]]))),
    "ms taken for s": (r"over 400 s", edit(times=lambda t: 1000 * t)),
    "s taken for ms": (r"over 0\.0004 s", edit(times=lambda t: t / 1000)),
    "two nodes": (
        f"nodes {min(find_nearest(0, 0, 0), find_nearest(3, 0, 0))}, .* state 3:",
        edit(displacement=exchange(3, find_nearest(0, 0, 0), find_nearest(3, 0, 0))),
    ),
    "two nodes far apart": ("state 3:", edit(displacement=exchange(3, MIDDLE, find_nearest(-18, 9, 0)))),
    "three nodes in turn": (
        "state 1:",
        edit(displacement=exchange(1, find_nearest(0, 0, 0), find_nearest(3, 0, 0), find_nearest(0, 3, 0))),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", DOUBTFUL)
def test_what_is_unlikely_of_tissue_is_said(case: str, tmp_path: Path) -> None:
    pattern, write_case = DOUBTFUL[case]
    doubts = find_doubts(write_case(tmp_path))
    assert len([doubt for doubt in doubts if re.search(pattern, doubt)]) == 1
    assert not any("\n" in doubt for doubt in doubts)


@pytest.mark.parametrize("turn", [0.0, 0.7])
@pytest.mark.parametrize(
    ("axis", "sideways", "doubt_count"), [(None, 0.1, 0), (0, 0.1, 1), (1, -0.1, 1), (0, 0.005, 0)]
)
def test_a_mirrored_motion_under_a_press_is_doubted(
    axis: int | None, sideways: float, doubt_count: int, turn: float
) -> None:
    """Of a dimple under which tissue moves towards its middle by a share of the distance."""
    side = np.linspace(-15, 15, 31)
    flat = np.stack([*map(np.ravel, np.meshgrid(side, side)), np.zeros(961)], axis=1)
    dent = np.exp(-(flat**2).sum(axis=1) / 32)[:, None]
    u = -dent * (sideways * flat + [0, 0, 2.0])
    load = np.maximum(1 - (flat**2).sum(axis=1) / 25, 0)[:, None] * [0, 0, -1.0]
    if axis is not None:
        u[:, axis] *= -1
    tilt = Rotation.from_euler("xyz", [turn, turn, turn]).as_matrix()
    points, u, load = flat @ tilt.T, u @ tilt.T, load @ tilt.T
    faces = Delaunay(flat[:, :2]).simplices
    mirror_doubts = plausibility.find_mirror_doubt(
        points, faces, np.stack([0 * u, u]), np.stack([0 * u, load])
    )
    assert len(mirror_doubts) == doubt_count


def press(states: int) -> tuple[Floats, Floats]:
    """Displacement (S, N, 3) of a press that grows, moves sideways, holds and ends, and its times [s]."""
    time = np.linspace(0, 1, states)
    size = np.interp(time, [0.1, 0.4, 0.6, 0.9], [0, 1, 1, 0])
    size = size**2 * (3 - 2 * size)
    shift = np.roll(solve().u, 1, axis=1)
    return size[:, None, None] * (solve().u + 0.3 * time[:, None, None] * shift), time


@pytest.mark.parametrize("states", [12, 20, 40])
def test_two_states_that_changed_places_are_named(states: int) -> None:
    u, time = press(states)
    assert plausibility.find_exchanged_states(u, time) == []
    first_state, second_state = states // 5, states // 2
    u[[first_state, second_state]] = u[[second_state, first_state]]
    (doubt,) = plausibility.find_exchanged_states(u, time)
    assert f"states {first_state} and {second_state} " in doubt


@pytest.mark.parametrize("form", FORMS)
def test_a_plausible_series_raises_no_doubt(form: str, tmp_path: Path) -> None:
    assert find_doubts(write(tmp_path, form)) == []


@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_a_wrong_unit_of_force_is_seen_without_a_stiffness(factor: float, tmp_path: Path) -> None:
    (doubt,) = find_doubts(edit(contact=lambda f: factor * f)(tmp_path), None)
    assert f"{1.2 * factor:.1e} kPa".replace(".0e", "e") in doubt or f"{1.2 * factor:.2g} kPa" in doubt


def test_the_contact_of_a_uniform_pressure_has_its_own_radius() -> None:
    """Of a disk of 12 mm on a fine grid, loaded evenly; of a paraboloid (3/4)^(1/2) of it."""
    axis = np.linspace(-20, 20, 161)
    points = np.stack([*np.meshgrid(axis, axis), np.zeros((161, 161))], axis=-1).reshape(-1, 3)
    corner = np.arange(161 * 160)[np.arange(161 * 160) % 161 < 160]
    faces = np.concatenate([corner[:, None] + [0, 1, 162], corner[:, None] + [0, 162, 161]])
    load = np.maximum(1 - (points**2).sum(axis=1) / 144, 0)[:, None] * [0, 0, -1.0]
    assert contact_radius(points, faces, np.sign(load)) == pytest.approx(12, rel=0.01)
    assert contact_radius(points, faces, load) == pytest.approx(12 * np.sqrt(0.75), rel=0.01)


def test_a_rigid_body_is_told_from_a_bent_one() -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (500, 3))
    turn = Rotation.from_rotvec([0.1, -0.3, 0.2]).as_matrix()
    displacement = points @ turn.T + [1, 2, 3] - points
    assert is_rigid(points, displacement)
    assert not is_rigid(points, displacement + 0.05 * np.sin(points[:, :1] / 5) * [0, 0, 1.0])


def pack_blocks(*blocks: bytes, size: int, last_size: int = 0) -> str:
    """The base64 text of compressed blocks whose header states `size` bytes each."""
    head = np.array([len(blocks), size, last_size, *map(len, blocks)], "<u4").tobytes()
    return base64.b64encode(head).decode() + base64.b64encode(b"".join(blocks)).decode()


def build_vtu(points: str, count: int, extra_array: str = "") -> bytes:
    """A .vtu of one tetrahedron and `count` points, with another array at them."""
    text = (
        '<VTKFile type="UnstructuredGrid" byte_order="LittleEndian" compressor="vtkZLibDataCompressor">'
        f'<UnstructuredGrid><Piece NumberOfPoints="{count}" NumberOfCells="1"><Points><DataArray '
        f'type="Float32" NumberOfComponents="3" format="binary">{points}</DataArray></Points><Cells>'
        '<DataArray type="Int32" Name="connectivity" format="ascii">0 1 2 3</DataArray>'
        '<DataArray type="Int32" Name="offsets" format="ascii">4</DataArray>'
        '<DataArray type="UInt8" Name="types" format="ascii">10</DataArray></Cells>'
        f"<PointData>{extra_array}</PointData></Piece></UnstructuredGrid></VTKFile>"
    )
    return text.encode()


TETRAHEDRON = np.concatenate([np.zeros((1, 3)), np.eye(3)])
POINTS = pack_blocks(zlib.compress(TETRAHEDRON.astype("<f4").tobytes()), size=48)
HUGE = zlib.compress(bytes(1 << 24))
LEGACY = b"# vtk DataFile Version 3.0\nt\nASCII\nDATASET UNSTRUCTURED_GRID\n"
ENTITIES = '<!DOCTYPE x [<!ENTITY a "b">]><VTKFile type="UnstructuredGrid">&a;</VTKFile>'

BOMBS = {
    "a block larger than it states": build_vtu(pack_blocks(HUGE, size=48), 4),
    "more blocks than it has": build_vtu("AAAAgAEAAAABAAAA", 4),
    "all that it states, of 12 GB": build_vtu(pack_blocks(*[HUGE] * 768, size=1 << 24), (768 << 24) // 12),
    "blocks of no size": build_vtu(pack_blocks(HUGE, size=0), 4),
    "entities in UTF-16": ENTITIES.encode("utf-16"),
    "entities": ENTITIES.encode(),
    "cells": LEGACY + b"POINTS 1 float\n0 0 0\nCELLS 1000000000 1\n0\n",
    "cells of a negative size": LEGACY + b"POINTS 1 float\n0 0 0\nCELLS 3 6\n-1 4 0 0 0 0\n",
    "arrays of a field": LEGACY + b"FIELD f 1000000000000\n",
    "texts of a field": LEGACY + b"FIELD f 1\na 1 1000000000000 string\nx\n",
    "points": LEGACY + b"POINTS 1000000000000000 float\n0 0 0\n",
    "a negative number of points": LEGACY.replace(b"ASCII", b"BINARY") + b"POINTS -1 float\n" + bytes(12),
}  # fmt: skip


@pytest.mark.parametrize("case", BOMBS)
def test_what_a_mesh_declares_is_held_against_its_bytes(case: str) -> None:
    """In 200 MB beyond what the process has, without a loop over what isn't there."""
    with limit_memory(200 << 20), pytest.raises(ValueError, match=r"."):
        read_mesh(BOMBS[case])


def test_arrays_that_are_not_needed_are_not_expanded() -> None:
    template = '<DataArray type="Float64" Name="{}" NumberOfComponents="3" format="binary">{}</DataArray>'
    u = pack_blocks(zlib.compress(np.arange(12.0).astype("<f8").tobytes()), size=96)
    with limit_memory(200 << 20):
        mesh = read_mesh(
            build_vtu(POINTS, 4, template.format("u", u) + template.format("x", pack_blocks(HUGE, size=96)))
        )
        np.testing.assert_array_equal(mesh.point_data["u"].read(), np.arange(12.0).reshape(4, 3))
        with pytest.raises(ValueError, match=r"another size|expands"):
            mesh.point_data["x"].read()


@pytest.mark.parametrize("strips", [False, True])
def test_polygons_and_strips_become_triangles_that_face_alike(strips: bool) -> None:
    """A fan of a hexagon and of a square; a strip of a band: areas add up, normals agree."""
    ring = np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3), np.zeros(6)], axis=1)
    if strips:
        ring = np.array([[k // 2, k % 2, 0] for k in range(6)], float)
    rows = "6 0 1 2 3 4 5\n4 0 1 2 3\n" if not strips else "6 0 2 1 3 4 5\n".replace("2 1", "1 2")
    kind = "TRIANGLE_STRIPS" if strips else "POLYGONS"
    text = "\n".join(" ".join(map(str, row)) for row in ring.tolist())
    size = 12 if not strips else 7
    data = f"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS 6 float\n{text}\n"
    mesh = read_mesh(f"{data}{kind} {2 - strips} {size}\n{rows}".encode())
    a, b, c = (mesh.points[mesh.cells[5][:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)[:, 2] / 2
    assert len({bool(normal > 0) for normal in normals}) == 1
    area = 2.0 if strips else 1.5 * np.sqrt(3) + 0.75 * np.sqrt(3)
    assert np.abs(normals).sum() == pytest.approx(area)


@pytest.mark.parametrize("kind", SURFACES)
def test_surfaces_that_move_are_read_in_their_order(kind: str, tmp_path: Path) -> None:
    """As OBJ with groups, materials (which are not opened) and textures, PLY and GLB, written by trimesh."""
    block = solve()
    nodes, faces = np.unique(skin(block.points, {10: block.tets}), return_inverse=True)
    for k in range(STATES):
        mesh = trimesh.Trimesh(
            block.points[nodes] + block.scale[k] * block.u[nodes], faces.reshape(-1, 3), process=False
        )
        data = mesh.export(file_type=kind)
        data = data.encode() if isinstance(data, str) else data
        if kind == "obj":
            lines = (
                f"f {' '.join(f'{word}/{1 + k % 2}' for word in line[2:].split())}"
                if line[:2] == "f "
                else line
                for line in data.decode().splitlines()
            )
            data = ("mtllib m.mtl\no größe\nvt 0 0\nvt 1 1\nusemtl a\n" + "\n".join(lines) + "\n").encode(
                "latin-1"
            )
        (tmp_path / f"s_{k}.{kind}").write_bytes(data)
    os.mkfifo(tmp_path / "m.mtl")
    series = read_series(tmp_path / f"s_*.{kind}", Units(1.0, dt_s=STEP_S))
    series_order, block_order = (
        np.lexsort(points.round(3).T) for points in (series.points, block.points[nodes])
    )
    np.testing.assert_allclose(series.points[series_order], block.points[nodes][block_order], atol=1e-5)
    np.testing.assert_allclose(series.displacement[2][series_order], block.u[nodes][block_order], atol=1e-5)


HOSTILE_SURFACES = {
    "a face of a million corners": ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + b"1 " * 10**6),
    "a face that is continued": ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + b"1 \\\n" * 10**5 + b"1\n"),
    "a count beyond the bytes": ("ply", b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nend_header\n"),
    "arrays without bytes": ("glb", glb({"accessors": [{"count": 10**9, "type": "VEC3"}]})),
    "a file outside": ("glb", glb({"buffers": [{"uri": "../../etc/passwd", "byteLength": 10}]})),
    "a chain of nodes": ("glb", glb({"nodes": [{"children": [k + 1]} for k in range(20_000)]})),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE_SURFACES)
def test_a_surface_that_would_take_long_is_refused(case: str) -> None:
    kind, data = HOSTILE_SURFACES[case]
    with limit_memory(200 << 20), pytest.raises(ValueError, match=r"."):
        read_surface(data, kind)


@pytest.mark.parametrize("name", ["../f.csv", "{}/f.csv", "link.csv", "pipe.csv", "sub/../../f.csv"])
def test_a_table_lies_in_the_folder_of_the_files(name: str, tmp_path: Path) -> None:
    source = write(tmp_path / "in", "ascii")
    (tmp_path / "f.csv").write_text(TABLE)
    (tmp_path / "in/link.csv").symlink_to(tmp_path / "f.csv")
    os.mkfifo(tmp_path / "in/pipe.csv")
    for tables in ({"force": name.format(tmp_path)}, {"force": FORCE, "instruments": name.format(tmp_path)}):
        with pytest.raises(UserError, match=r"folder|regular"):
            read_series(source, Units(1.0, 1.0, STEP_S), **tables)


@pytest.mark.parametrize(
    ("table", "pattern"),
    [
        ("time,fx,fy,fz\n0,0,0,0\n1,1,0,0\n", "x, y, z"),
        (TABLE.replace("\n0.5", "\n0.1"), "rise"),
        (TABLE.replace("0.5,", "0.3,"), "0.4"),
        (TABLE.replace("0,0,0,0,1,0,0", "0,1,0,-2,1,0,0", 1), "rest"),
        (TABLE.replace(",1,0,0", ",100,0,0"), "4 mm"),
        (TABLE.replace("-4", ""), "missing"),
    ],
)
def test_a_bad_table_is_refused_by_name(table: str, pattern: str, tmp_path: Path) -> None:
    source = write(tmp_path, "ascii")
    (tmp_path / "force.csv").write_text(table)
    with pytest.raises(UserError, match=rf"force\.csv.*{pattern}"):
        read(source, force="force.csv")


@pytest.mark.parametrize(
    ("units", "key"),
    [(Units(None, 1, 0.1), "unit_mm"), (Units(1, None, 0.1), "unit_mn"), (Units(1, 1), "dt_s")],
)
def test_what_files_do_not_state_is_needed(units: Units, key: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=rf"mechanics\.{key}"):
        read_series(write(tmp_path, "ascii"), units, FORCE)
