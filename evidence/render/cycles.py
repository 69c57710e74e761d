"""Our pictures against Blender's Cycles at equal noise: same meshes, maps, lamps, lens; direct light only."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from evidence.measuring import measuring
from evidence.render.case import Case, case
from synth.errors import UserError
from synth.job.schema import Job
from synth.render import instrument
from synth.render.mitsuba.adapter import Wet

Map = npt.NDArray[np.float32]


@measuring("--python bpy/bin/python", said="Folder for cycles.json.", file="cycles.json")
def cycles(
    python: Annotated[Path, typer.Option(help="A Python that has bpy (pip install bpy).")],
    spp: Annotated[list[int], typer.Option(help="Samples a pixel to try.")] = [1, 2, 4, 8],  # noqa: B006
    seed: Annotated[int, typer.Option(help="Of the job.")] = 11,
) -> dict[str, Any]:
    """CPU-seconds and noise of a 640x480 frame, Mitsuba's and Cycles', and their ratio at equal noise."""
    job = Job.model_validate(
        {"seed": seed, "render": {"distortion": [0.0] * 5, "aperture_mm": 0.0, "variant": "llvm_ad_rgb"}}
    )
    ours = case(job, 0)
    inside = ours.studio.still.tissue & ~ours.studio.frame(ours.vertices, ours.tips, ours.shafts, 0).tool
    rows: list[dict[str, Any]] = []
    for n in spp:
        found, grey = _mitsuba(ours, n, inside)
        rows.append({"renderer": "mitsuba", "spp": n} | found)
    with tempfile.TemporaryDirectory() as folder:
        rows += _cycles(ours, Path(folder), python, spp, inside, grey)
    return {
        "seed": seed,
        "rows": rows,
        "ratio_at_equal_noise": ratio(rows, "noise"),
        "ratio_at_equal_noise_clipped": ratio(rows, "noise_clipped"),
    }


def ratio(rows: list[dict[str, Any]], kind: str) -> float:
    """Cycles' CPU time over Mitsuba's at the noise of Mitsuba's 4 paths, log-log between its points.

    Beyond Cycles' points the nearest one's time stands, which makes the ratio a lower bound.
    """
    mine = next(row for row in rows if row["renderer"] == "mitsuba" and row["spp"] == 4)
    theirs = sorted((row[kind], row["cpu_s"]) for row in rows if row["renderer"] == "cycles")
    noise, spent = np.log(np.array(theirs)).T
    return float(np.exp(np.interp(np.log(mine[kind]), noise, spent)) / mine["cpu_s"])


def _mitsuba(ours: Case, spp: int, inside: npt.NDArray[np.bool_]) -> tuple[dict[str, float], float]:
    """Time and noise, and the median of the light."""
    tool = instrument.pose(instrument.build(("forceps",)), ours.tips, ours.shafts)
    stage = ours.studio.stage(ours.vertices, tool, spp)
    spent, pictures = [], []
    for k in range(3):
        start = time.process_time()
        stage.move("cortex", ours.vertices)
        pictures.append(stage.render(k))
        spent.append(time.process_time() - start)
    found = {"cpu_s": round(min(spent[1:]), 3)} | noises(pictures[1], pictures[2], inside)
    return found, float(np.median(pictures[1][inside]))


def _cycles(
    ours: Case, folder: Path, python: Path, spp: list[int], inside: npt.NDArray[np.bool_], grey: float
) -> list[dict[str, Any]]:
    """As `_mitsuba`; Cycles' lamps have other units, so that white is where ours is for the same median."""
    _export(ours, folder, spp)
    worker = Path(__file__).with_name("cycles_worker.py")
    # Its own packages and nothing of ours.
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    # -P: in the worker's own folder this file is named as Blender's add-on is, which would not be found.
    command = [str(python), "-P", str(worker), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env=clean)
    if done.returncode or not (folder / "times.json").exists():
        raise UserError(
            f"{python}: Cycles did not run ({(done.stderr.strip() or 'no message').splitlines()[-1]})"
        )
    told = json.loads((folder / "times.json").read_text("utf-8"))
    rows = []
    for n in spp:
        pictures = [np.load(folder / f"cycles-{n}-{k}.npy") for k in (1, 2)]
        rows.append(
            {
                "renderer": "cycles",
                "version": told["version"],
                "spp": n,
                "cpu_s": round(min(told["cpu_s"][str(n)][1:]), 3),
            }
            | noises(pictures[0], pictures[1], inside, float(np.median(pictures[0][inside])) / grey)
        )
    return rows


def _export(ours: Case, folder: Path, spp: list[int]) -> None:
    studio = ours.studio
    tool = instrument.pose(instrument.build(("forceps",)), ours.tips, ours.shafts)
    arrays: dict[str, Any] = {"rotation": studio.camera.rotation, "centre": studio.camera.centre}
    bodies: dict[str, Any] = {}
    for name, body in studio.bodies(ours.vertices, tool).items():
        arrays |= {f"{name}_vertices": body.vertices, f"{name}_faces": body.faces, f"{name}_uv": body.uv}
        if isinstance(body.material, Wet):
            arrays |= {
                f"{name}_albedo": body.material.albedo,
                f"{name}_normal": body.material.normal / 2 + 0.5,
            }
            bodies[name] = {
                "albedo": True,
                "roughness": body.material.roughness,
                "index": body.material.index,
            }
        else:
            bodies[name] = {"roughness": 0.25, "metallic": 0.9}
    lamps = [
        {
            "position": lamp.position.tolist(),
            "target": lamp.target.tolist(),
            "intensity": list(lamp.intensity),
            "radius": lamp.radius,
        }
        for lamp in studio.lamps
    ]
    told = {
        "bodies": bodies,
        "lamps": lamps,
        "focal_px": float(studio.camera.K[0, 0]),
        "size": list(studio.camera.size),
        "spp": spp,
        "threads": int(os.environ.get("SULCUS_THREADS", os.cpu_count() or 1)),
    }
    np.savez(folder / "scene.npz", **arrays)
    (folder / "scene.json").write_text(json.dumps(told), "utf-8")


def noises(one: Map, two: Map, inside: npt.NDArray[np.bool_], white: float = 1.0) -> dict[str, float]:
    """Root mean square of a picture's noise over a mask, as a share of the mean: of all its light, where
    mirrored lamps weigh most, and of what a camera keeps of it, whose full scale is a white surface's light.
    """
    kinds = {"noise": (one, two), "noise_clipped": (np.minimum(one, white), np.minimum(two, white))}
    return {
        kind: round(float(np.sqrt(((a - b)[inside] ** 2).mean() / 2) / a[inside].mean()), 5)
        for kind, (a, b) in kinds.items()
    }
