"""Laws of other packages: the same answers where they are the same law, and refused where they are none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import own_law
import pytest
import tiny_package
from dome import ANATOMY
from numpy.typing import NDArray

import synth
from synth.fem import foreign_law
from synth.fem.laws import lame
from synth.fem.mesh import tetrahedra
from synth.fem.system import assemble
from synth.job import law_plugins
from synth.tune import knobs

ROOT = Path(__file__).resolve().parents[3]
GROUP = law_plugins.GROUP
Floats = NDArray[np.float64]


class NeoHookean:
    """Ours, written again."""

    largest_load = 0.4

    def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
        log = np.log(np.linalg.det(f))
        turned = np.linalg.inv(f).transpose(0, 2, 1)
        energy = mu / 2 * (np.einsum("nij,nij->n", f, f) - 3) - mu * log + lam / 2 * log**2
        return energy, mu * (f - turned) + (lam * log)[:, None, None] * turned


@pytest.fixture(scope="module")
def own() -> str:
    synth.add_law("test-neo-hookean", NeoHookean())
    return "test-neo-hookean"


@pytest.mark.parametrize("averaged", [False, True])
def test_the_same_law_gives_the_same_equations(own: str, averaged: bool) -> None:
    tets = tetrahedra.block(ANATOMY, 400, 2)
    theirs, ours = (assemble(tets, law, 0.45, averaged=averaged) for law in (own, "neo-hookean"))
    assert (ours.averaged > 0) == averaged
    u = 0.2 * np.random.default_rng(0).normal(size=tets.points.shape)
    one, other = theirs.state(u), ours.state(u)
    assert one.energy == pytest.approx(other.energy, rel=1e-10)
    assert one.jacobian == pytest.approx(other.jacobian, rel=1e-10)
    np.testing.assert_allclose(one.force, other.force, atol=1e-9 * np.abs(other.force).max())
    apart = abs(theirs.tangent(u) - ours.tangent(u)).max()
    assert apart < 1e-6 * abs(ours.tangent(u)).max(), "by differences, so not to rounding"


@pytest.mark.slow
@pytest.mark.parametrize("more", [{}, {"time": "dynamic"}, {"contact": "rigid"}, {"membrane": {"intact": 1}}])
def test_the_same_law_moves_the_tissue_alike(own: str, more: dict[str, object]) -> None:
    def moved(law: str) -> Floats:
        fem = {"law": law, "load": 0.2, "tets": 400, "gestures": ["push"], **more}
        small = {"seed": 2, "frames": 4, "anatomy": {"vertices": 2500}, "fem": fem}
        return synth.simulate(synth.Job.model_validate(small)).motion.displacement

    theirs, ours = moved(own), moved("neo-hookean")
    assert np.abs(theirs - ours).max() < 1e-6 * np.abs(ours).max()


def test_past_its_range_it_is_refused_in_one_line(own: str) -> None:
    with pytest.raises(
        synth.UserError, match=r"load 0\.5 is past the range of the test-neo-hookean law.* 0\.4"
    ):
        synth.load_job("tiny", [f"fem.law={own}", "fem.load=0.5"])
    with pytest.raises(synth.UserError, match=r"no law 'neo-hooke'.*did you mean 'neo-hookean'"):
        synth.load_job("tiny", ["fem.law=neo-hooke"])
    with pytest.raises(synth.UserError, match="is taken"):
        synth.add_law(own, NeoHookean())


def test_auto_never_takes_it_and_tuning_never_leaves_it(own: str) -> None:
    assert synth.Job().fem.chosen_law[0] == "neo-hookean"
    asked = synth.load_job("tiny", [f"fem.law={own}"])
    (law,) = (knob for knob in knobs.list_knobs(asked) if knob.name == "law")
    assert [level.words for level in law.levels] == [own]


def spoilt(change: str) -> type[NeoHookean]:
    """The law with something wrong in it."""

    class Spoilt(NeoHookean):
        def stress(self, f: Floats, mu: float, lam: float) -> tuple[Floats, Floats]:
            if change == "lambda":
                lam = lam**0.9 if lam > 1.5 else lam
            energy, first = super().stress(f, mu, lam)
            log = np.log(np.linalg.det(f))
            if change == "slope":
                first = first + 0.01 * mu * (f - np.eye(3)) * log[:, None, None]
            if change == "rest":
                energy, first = energy + 0.01 * np.trace(f, axis1=1, axis2=2), first + 0.01 * np.eye(3)
            if change == "soft":
                energy, first = 0.9 * energy, 0.9 * first
            if change == "turn":
                energy, first = energy + (f[:, 0, 1] ** 4), first.copy()
                first[:, 0, 1] += 4 * f[:, 0, 1] ** 3
            return (energy[:, None], first) if change == "shape" else (energy, first)

    return Spoilt


FAULTS = {
    "slope": "is not the slope of its energy",
    "rest": "is not zero at rest",
    "soft": "is not Hooke's near rest",
    "turn": "depends on how the whole is turned",
    "lambda": "takes lambda otherwise",
    "shape": "must give",
}


@pytest.mark.parametrize("change", FAULTS)
def test_one_that_would_be_silently_wrong_is_refused(change: str) -> None:
    foreign_law.check_law("sound", NeoHookean())
    mu, lam = lame(1.0, 0.4)
    assert lam > 1.4 > mu
    with pytest.raises(synth.UserError, match=FAULTS[change]):
        foreign_law.check_law("spoilt", spoilt(change)())


BROKEN = """
class Endless:
    largest_load = 1e9

    def stress(self, f, mu, lam): ...


def raises():
    1 / 0
"""


@pytest.mark.parametrize(
    ("at", "words"),
    [
        ("broken:Endless", "must be above 0"),
        ("broken:raises", "ZeroDivisionError"),
        ("nowhere:Law", "No module"),
    ],
)
def test_one_that_does_not_load_is_one_line(
    at: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = at.replace(":", "-")
    tiny_package.install(tmp_path, "broken", BROKEN, {GROUP: {name: at}}, monkeypatch)
    with pytest.raises(synth.UserError, match=words) as raised:
        synth.load_job("tiny", [f"fem.law={name}"])
    assert len(str(raised.value).splitlines()) == 1


@pytest.mark.slow
def test_a_dataset_with_a_law_of_another_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Through the command and its worker processes, which find the package as this process does."""
    code = Path(own_law.__file__).read_text("utf-8")
    points = {GROUP: {"stiffening": "stiff:Stiffening"}}
    folder = tiny_package.install(tmp_path / "site", "stiff", code, points, monkeypatch)
    small = ["frames=3", "sequences=1", "anatomy.vertices=2500", "fem.tets=400", "render.spp=1"]
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    for words in (
        ["render", "tiny", "-o", "out", *small, "fem.law=stiffening", "fem.load=0.2"],
        ["verify", "out"],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "synth", *words],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    (sequence,) = synth.Dataset(tmp_path / "out")
    mechanics = sequence.attrs["mechanics"]
    assert (mechanics["law"], mechanics["law_from"]) == ("stiffening", "stiff 1.2")
