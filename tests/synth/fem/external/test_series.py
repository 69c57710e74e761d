"""Series of other programs: every format gives the same states, whatever can't be used is refused by name."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pressed_block
import pytest
from pressed_block import STATES, STEP_S, solve, write

from synth.arrays import Floats, Ints
from synth.errors import UserError
from synth.fem.external.read import read_series
from synth.fem.external.series import MeshSeries, Units

FORMS = ("ascii", "binary", "vtk", "moving", "npz", "points")
FORCE = "nodal:contact"
TABLE = "time,fx,fy,fz,x,y,z\n0,0,0,0,1,0,0\n0.2,1.5,0,-4,1,0,0\n0.5,0,0,0,1,0,0\n"


def read(source: Path, mm: float = 1.0, mn: float = 1.0, force: str | None = FORCE) -> MeshSeries:
    return read_series(source, Units(mm, mn, STEP_S), force)


def ordered(series: MeshSeries) -> list[Floats]:
    """Points at rest, and displacement and force of the third state, in an order that all formats share."""
    assert series.force is not None
    order = np.lexsort(series.points.round(3).T)
    return [series.points[order], series.displacement[2][order], series.force[2][order]]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("mm", "mn"), [(1.0, 1.0), (1000.0, 1000.0)])
def test_every_format_and_unit_gives_the_same_states(form: str, mm: float, mn: float, tmp_path: Path) -> None:
    block, series = solve(), read(write(tmp_path / "s", form, mm, mn), mm, mn)
    assert series.time == pytest.approx(STEP_S * np.arange(STATES))
    outer = np.isclose(np.abs(block.points - [0, 0, -9]), [24, 24, 9]).any(axis=1)
    order = np.flatnonzero(outer)[np.lexsort(block.points[outer].round(3).T)]
    for found, true in zip(ordered(series), (block.points, block.u, block.force), strict=True):
        np.testing.assert_allclose(found, true[order], atol=3e-6 * np.abs(true).max())
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
        with np.load(source) as held:
            arrays = dict(held)
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
    with np.load(source) as held:
        arrays = dict(held)
    single = block.tets.ravel()  # a node for each corner of each cell, as discontinuous elements have
    share = 1 / np.bincount(single)[single]
    arrays |= {"rest": arrays["rest"][single], "displacement": arrays["displacement"][:, single]}
    arrays |= {"contact": arrays["contact"][:, single] * share[:, None]}
    np.savez(tmp_path / "t.npz", **arrays | {"tetrahedra": np.arange(single.size).reshape(-1, 4)})
    for found, true in zip(ordered(read(tmp_path / "t.npz")), ordered(read(source)), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-6)


def change(name: str, old: str, new: str, form: str = "ascii") -> Callable[[Path], Path]:
    """A series with the first match of a pattern in one of its files replaced."""

    def made(folder: Path) -> Path:
        source, file = write(folder, form), folder / name
        text = file.read_text("latin-1")
        assert re.search(old, text, re.DOTALL)
        file.write_text(re.sub(old, new, text, count=1, flags=re.DOTALL), "latin-1")
        return source

    return made


def arrays(**changed: Callable[[Floats], Floats] | None) -> Callable[[Path], Path]:
    """An .npz with arrays changed, or left out."""

    def made(folder: Path) -> Path:
        source = write(folder, "npz")
        with np.load(source) as held:
            every = dict(held)
        for name, how in changed.items():
            value = every.pop(name)
            every |= {} if how is None else {name: how(value)}
        np.savez(source, **every)
        return source

    return made


def without(name: str, form: str) -> Callable[[Path], Path]:
    def made(folder: Path) -> Path:
        source = write(folder, form)
        (folder / name).unlink()
        return source

    return made


def remeshed(folder: Path) -> Path:
    source = write(folder, "ascii")
    block = solve(4.0)
    fields = {"displacement": block.u, "contact": block.force}
    (folder / "block_2.vtu").write_text(pressed_block.ascii_vtu(block.points, block.tets, fields))
    return source


def two_series(folder: Path) -> Path:
    write(folder, "ascii")
    (folder / "tool_0.vtu").write_bytes((folder / "block_0.vtu").read_bytes())
    return folder


def apart(tets: Ints) -> Ints:
    """Without the cells in the middle."""
    return tets[solve().points[tets][..., 0].mean(axis=1) ** 2 > 25]


def first(one: Floats) -> Floats:
    return one[:1]


def at(k: int, value: float) -> Callable[[Floats], Floats]:
    def put(one: Floats) -> Floats:
        one = one.astype(float)
        one[k, 0, 0] = value
        return one

    return put


BAD: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "a file is missing in the middle": (r"block_1\.vtu.*block_3\.vtu", without("block_2.vtu", "ascii")),
    "a listed file is missing": (r"block_2\.vtu", without("block_2.vtu", "binary")),
    "not a number": (r"s\.npz", arrays(displacement=at(2, np.nan))),
    "infinite force": (r"s\.npz", arrays(contact=at(2, np.inf))),
    "not a number at rest": (r"s\.npz", arrays(rest=lambda x: np.where(x == x[0], np.nan, x))),
    "remeshed": (r"block_2\.vtu", remeshed),
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
    "loaded at first": (r"s\.npz", arrays(contact=lambda f: f + f[2])),
    "displaced at first": (r"s\.npz", arrays(displacement=lambda u: u + u[2])),
    "net force": (r"net force", arrays(contact=lambda f: f * ([0, 1, 0, 1, 0] @ np.eye(5))[:, None, None])),
    "no force at all": (r"0 mN", arrays(contact=np.zeros_like)),
    "times run back": (r"block_3\.vtu", change("block.pvd", r'"0\.3\d*"', '"0.1"', "binary")),
    "times missing": (r"s\.npz", arrays(times=lambda t: np.zeros_like(t))),
    "metres as millimetres": (r"1000 for m", arrays(rest=lambda x: x / 1e3, displacement=lambda u: u / 1e3)),
    "mixed units": (r"s\.npz.*unit_mm", arrays(displacement=lambda u: u / 1e5)),
    "several series": (r"block_\*\.vtu, tool_\*\.vtu", two_series),
    "one state": (r"s\.npz", arrays(displacement=first, contact=first, times=first)),
    "no cells": (r"s\.npz", arrays(tetrahedra=None)),
    "shapes differ": (r"\(5, .*\(4,", arrays(times=lambda t: t[:4])),
    "duplicate nodes that part": (r"s\.npz", arrays(rest=lambda x: np.where(x == x[7], x[8], x))),
    "separate bodies": (r"2 separate", arrays(tetrahedra=apart)),
    "a collection of nothing": (r"block\.pvd", change("block.pvd", "<DataSet.*/>", "", "binary")),
    "a file outside": (r"\.\./b", change("block.pvd", 'file="b', 'file="../b', "binary")),
    "another engine's format": (r"\.frd.*VTU", lambda folder: folder / "block.frd"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_a_bad_series_is_refused_in_one_line_that_names_it(what: str, tmp_path: Path) -> None:
    named, made = BAD[what]
    source = made(tmp_path)
    with pytest.raises(UserError, match=named) as refused:
        read(source)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ("time,fx,fy,fz\n0,0,0,0\n1,1,0,0\n", "x, y, z"),
        (TABLE.replace("\n0.5", "\n0.1"), "rise"),
        (TABLE.replace("0.5,", "0.3,"), "0.4"),
        (TABLE.replace("0,0,0,0,1,0,0", "0,1,0,-2,1,0,0", 1), "rest"),
        (TABLE.replace(",1,0,0", ",100,0,0"), "4 mm"),
        (TABLE.replace("-4", ""), "missing"),
    ],
)
def test_a_bad_table_is_refused_by_name(table: str, named: str, tmp_path: Path) -> None:
    source = write(tmp_path, "ascii")
    (tmp_path / "force.csv").write_text(table)
    with pytest.raises(UserError, match=rf"force\.csv.*{named}"):
        read(source, force="force.csv")


@pytest.mark.parametrize(
    ("units", "key"),
    [(Units(None, 1, 0.1), "unit_mm"), (Units(1, None, 0.1), "unit_mn"), (Units(1, 1), "dt_s")],
)
def test_what_files_do_not_state_is_needed(units: Units, key: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=rf"mechanics\.{key}"):
        read_series(write(tmp_path, "ascii"), units, FORCE)
