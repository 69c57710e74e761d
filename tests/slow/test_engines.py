"""Other programs' finite elements: their motion and force are those of the rendered sequence."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import calculix_block
import felupe_membrane
import numpy as np
import pytest
import sofa_layout
from scipy import ndimage

import synth
from synth.checks.verify import verify_dataset
from synth.render.camera import camera

CALL = (
    "import sys, pathlib as p, felupe_membrane as m; m.solve(p.Path(sys.argv[1]), *map(float, sys.argv[2:]))"
)


def install(*command: object) -> None:
    """Runs a command; skips the test if that is not possible."""
    result = subprocess.run([*map(str, command)], capture_output=True, text=True)
    if result.returncode:
        pytest.skip(f"can't be installed: {result.stderr.strip()[-200:]}")


def calculix(folder: Path, mm: float, mn: float) -> tuple[dict[str, Any], Any]:
    """Section `mechanics` of a job, and the force (S, 3) mN by which the engine holds the body."""
    if shutil.which("ccx") is None:
        install("apt-get", "install", "-y", "-q", "calculix-ccx")
    mechanics = calculix_block.solve(folder, mm, mn, fine=11)
    totals = re.findall(r"total force.*\s+(.*)", (folder / "block.dat").read_text())
    return mechanics, mn * np.array(
        [[0.0] * 3, *([float(number) for number in row.split()] for row in totals)]
    )


def felupe(folder: Path, mm: float, mn: float) -> tuple[dict[str, Any], Any]:
    python = (home := folder.parent / "felupe") / "bin" / "python"
    if not home.exists():
        install(sys.executable, "-m", "venv", home)
        install(python, "-m", "pip", "install", "-q", "felupe")
    environment = {**os.environ, "PYTHONPATH": str(Path(felupe_membrane.__file__).parent)}
    subprocess.run([python, "-c", CALL, folder, str(mm), str(mn)], check=True, env=environment)
    with np.load(folder / "sheet.npz") as arrays:
        mechanics = {"source": folder / "sheet.npz", "unit_mm": mm, "unit_mn": mn, "force": "nodal:suction"}
        return mechanics, mn * arrays["held"].sum(axis=1)


@pytest.mark.trial
@pytest.mark.parametrize(("solve", "example"), [(calculix, calculix_block), (felupe, felupe_membrane)])
def test_motion_and_force_are_the_engines_in_any_unit(solve: Any, example: Any, tmp_path: Path) -> None:
    stores, job_tree = [], {**example.JOB, "render": {"size": (160, 120)}}
    content = felupe_membrane.paint_speckles
    for mm, mn in ((1000.0, 1000.0), (1.0, 1.0)):
        (tmp_path / f"{mm}").mkdir()
        job_tree["mechanics"], reaction = solve(tmp_path / f"{mm}", mm, mn)
        with synth.open_dataset(tmp_path / f"{mm}" / "out", job := synth.Job.model_validate(job_tree)) as out:
            stores.append(synth.open_sequence(synth.write_scene(synth.simulate(job, content=content), out)))
        assert verify_dataset(out).good
        true = -reaction @ np.array(stores[-1].attrs["rotation"]).T
        np.testing.assert_allclose(stores[-1]["force"][:], true, atol=1e-4 * np.abs(true).max())
    for name in set(stores[0].fields) - {"rgb", "flow_recovered", "flow_confidence"}:
        first, second = (store[name][:].astype(float) for store in stores)
        np.testing.assert_allclose(first, second, rtol=0, atol=1e-4 * np.abs(first).max(), err_msg=name)
    fine = {"anatomy": {**example.JOB["anatomy"], "vertices": 400_000}, "render": {"size": (320, 240)}}
    scene = synth.simulate(synth.Job.model_validate({**job_tree, **fine}), content=content)
    flow, to_world = scene.frame(len(scene) - 1).flow, scene.brain.to_world  # type: ignore[union-attr]
    with np.load(job_tree["mechanics"]["source"]) as arrays:
        rest, u = arrays["rest"], arrays["displacement"][-1]
    top = (rest[:, 2] == 0) & (np.hypot(*rest[:, :2].T) < 12)
    world_points = (points[top] @ to_world[:3, :3].T + to_world[:3, 3] for points in (rest, rest + u))
    start, end = (camera.project(scene.view, points) for points in world_points)
    inside = ndimage.map_coordinates(scene.tissue.astype(float), start.T[::-1], order=1) == 1
    flow_px = [ndimage.map_coordinates(flow[..., d], start.T[::-1], np.float64, order=3) for d in (0, 1)]
    errors = np.linalg.norm(np.stack(flow_px, axis=1) - (end - start), axis=1)[inside]
    assert (inside.sum() > 50) & (np.median(errors) < 1e-3) & (errors.max() < 2e-2)


def test_a_series_in_sofas_layout(tmp_path: Path) -> None:
    job_tree = {**sofa_layout.JOB, "render": {"size": (160, 120)}, "mechanics": sofa_layout.write(tmp_path)}
    job = synth.Job.model_validate(job_tree)
    with synth.open_dataset(tmp_path / "out", job) as folder:
        synth.write_scene(synth.simulate(job, 0), folder)
    assert verify_dataset(tmp_path / "out").good
    force = synth.open_sequence(tmp_path / "out" / "000000.zarr")["force"][:]
    true = sofa_layout.FORCE_MN * np.sin(np.pi * np.arange(sofa_layout.STATES) / 8) ** 2
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), true, atol=1e-4)
