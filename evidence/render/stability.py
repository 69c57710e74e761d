"""Where the renderer breaks: every case must give a correct frame or a clear error, never a wrong label."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from bench.output import result_page
from evidence.measuring import measuring
from evidence.render.case import Case, case
from synth.errors import UserError
from synth.geometry.triangles import Shape
from synth.job.schema import Job, Render, Sensor
from synth.render.anatomy import surface
from synth.render.camera import video
from synth.render.camera.sway import Sway
from synth.render.scene import Moment
from synth.render.truth import still

_SMALL = {"size": (160, 120)}
_LIFT_MM = 2.0


@measuring(
    "--out runs/render",
    said="Folder for data and page.",
    file="stability.json",
    page=lambda found, out: result_page.write(drawn(found), out),
    passed=lambda found: all(row["passed"] for row in found["cases"]),
)
def stability(
    seed: Annotated[int, typer.Option(help="Of the jobs.")] = 11,
    only: Annotated[list[str] | None, typer.Option(help="Cases to try, by name; all if not given.")] = None,
) -> dict[str, Any]:
    """Steep folds, grazing views, extreme sizes, missing parts: a correct frame or a clear error."""
    rows: list[dict[str, Any]] = []
    unknown = set(only or []) - set(_TRIALS)
    if unknown:
        raise UserError(f"no case {sorted(unknown)[0]!r}; there are: {', '.join(_TRIALS)}")
    for name in only or _TRIALS:
        trial = _TRIALS[name]
        try:
            figures, outcome = trial(seed), "frame"
        except UserError as error:
            figures, outcome = {"error": str(error)}, "clear error"
        passed = outcome == "clear error" or float(figures.get("worst_px", 0.0)) < 1e-2
        rows.append({"case": name, "outcome": outcome, "passed": passed, **figures})
    return {"seed": seed, "cases": rows}


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What the data say."""
    title = "Rendering: a correct frame or a clear error"
    return result_page.Page(title, found, (), [result_page.Section("Cases", found["cases"])])


def checked(ours: Case, **changes: Any) -> dict[str, Any]:
    """Renders one frame and holds its labels against OpenCV's projection of the same material points.

    Raises:
        AssertionError: an array has a value that is not finite, or a mask contradicts another.
    """
    moved = changes.get("vertices", ours.moved(_LIFT_MM))
    tips, shafts = changes.get("tips", ours.held(_LIFT_MM)), changes.get("shafts", ours.shafts)
    rest, lens = ours.studio.still, changes.get("camera", ours.studio.camera)
    shot = ours.studio.shoot(Moment(moved, tips, shafts, lens), 3)
    for array in (shot.radiance, shot.flow, shot.depth, rest.area):
        assert np.isfinite(array).all()
    assert not (shot.visible & ~rest.tissue).any()
    assert not (shot.glare & shot.tool).any()
    faces = ours.studio.surface.faces[rest.face[rest.tissue]]
    points = np.einsum("nk,nkc->nc", rest.bary[rest.tissue], moved[faces])
    turn, _ = cv2.Rodrigues(lens.rotation)
    rows, columns = np.nonzero(rest.tissue)
    worst = 0.0
    if len(rows):
        seen, _ = cv2.projectPoints(points, turn, lens.translation, lens.K, lens.distortion)
        expected = seen[:, 0] - np.stack([columns, rows], axis=1)
        worst = float(np.abs(expected - shot.flow[rest.tissue]).max())
    return {
        "worst_px": worst,
        "tissue": round(float(rest.tissue.mean()), 3),
        "visible": round(float(shot.visible[rest.tissue].mean()) if len(rows) else 0.0, 3),
        "tool": round(float(shot.tool.mean()), 3),
        "mean_level": round(float(shot.rgb.mean()), 1),
    }


def _job(seed: int, **sections: Any) -> Job:
    return Job.model_validate({"seed": seed, "render": _SMALL, **sections})


def _render(seed: int, **render: Any) -> dict[str, Any]:
    return checked(case(_job(seed, render={**_SMALL, **render}), 0))


def _steep(seed: int) -> dict[str, Any]:
    """A wall steeper than the line of sight: the surface folds over itself in the picture."""
    ours = case(_job(seed, render={**_SMALL, "tilt_deg": 20.0}), 0)
    towards = ours.studio.camera.centre
    shift = np.where(np.abs(ours.vertices[:, 0]) < 2, 6.0, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    found = checked(ours, vertices=ours.vertices + shift)
    assert found["visible"] < 0.999, towards
    return found


def _filled_view(seed: int) -> dict[str, Any]:
    ours = case(_job(seed), 0)
    towards = ours.studio.camera.centre / np.linalg.norm(ours.studio.camera.centre)
    close = 240 * towards + np.array([[0.5, 0, 0], [-0.5, 0, 0]])
    return checked(ours, tips=close, shafts=np.array([[1.0, 0, 0.05], [-1.0, 0, 0.05]]))


def _behind(seed: int) -> dict[str, Any]:
    """An instrument that reaches past the lens."""
    ours = case(_job(seed), 0)
    towards = ours.studio.camera.centre / np.linalg.norm(ours.studio.camera.centre)
    return checked(ours, tips=np.stack([250 * towards] * 2), shafts=np.stack([towards] * 2))


def _overexposed(seed: int) -> dict[str, Any]:
    """Thirty times too much light: a white picture, and labels as ever."""
    found = checked(case(_job(seed, sensor={"exposure": 30.0}), 0))
    assert found["mean_level"] > 200
    return found


def _flat_maps(seed: int) -> dict[str, Any]:
    """Every vertex at the same place of the maps."""
    ours = case(_job(seed), 0)
    ours.studio.surface.uv[:] = 0.5
    return checked(ours)


def _swaying(seed: int) -> dict[str, Any]:
    """A microscope that drifts 3 mm and vibrates."""
    ours = case(_job(seed, render={**_SMALL, "drift_mm": 3.0, "vibration_mm": 0.1}), 0)
    sway = Sway.draw(Render(drift_mm=(3.0, 3.0), vibration_mm=(0.1, 0.1)), np.random.default_rng(seed))
    return checked(ours, camera=sway.at(ours.studio.camera, 3.7))


def _starved(seed: int) -> dict[str, Any]:
    """A bitrate that leaves nothing: still a film of the right size."""
    ours = case(_job(seed), 0)
    film = np.stack([ours.studio.frame(ours.moved(k), ours.held(k), ours.shafts, k).rgb for k in range(3)])
    back = video.recorded(film, Sensor(bitrate_mbps=0.02, chroma="4:2:0"), 25.0)
    assert back.shape == film.shape
    return {"worst_px": 0.0, "mean_level": round(float(back.mean()), 1)}


def _no_calibration(seed: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lens.yaml"
        path.write_text("%YAML:1.0\n---\nlens: a good one\n")
        return _render(seed, calibration=path)


def _degenerate(seed: int) -> dict[str, Any]:
    """Faces of no area, and two vertices in one place."""
    ours = case(_job(seed), 0)
    vertices = ours.vertices.copy()
    vertices[5000:5400] = vertices[5000]
    return checked(ours, vertices=vertices)


def _empty(seed: int) -> dict[str, Any]:
    """A surface that is not in the picture at all."""
    ours = case(_job(seed), 0)
    aside = Shape(ours.vertices + np.array([200.0, 0, 0]), ours.studio.surface.faces)
    assert not still(ours.studio.camera, aside, aside).tissue.any()
    return {"tissue": 0.0, "worst_px": 0.0}


def _holes(seed: int) -> dict[str, Any]:
    """A user's brain with nothing under the opening."""
    job = _job(seed)
    flat = np.array([[30.0, 30, 0], [60, 30, 0], [30, 60, 0]])
    relief = surface.Relief(seed=1, gyrus_mm=12.0, sulcus_mm=1.0)
    surface.from_brain(flat, np.array([[0, 1, 2]], np.int32), relief, job.anatomy)
    raise AssertionError("a hole was taken for a brain")


def _in_process(code: str, **environment: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, **environment}
    )
    if done.returncode:
        raise UserError(done.stderr.strip().splitlines()[-1].removeprefix("synth.errors.UserError: "))
    return {"said": done.stdout.strip()}


def _no_llvm(seed: int) -> dict[str, Any]:
    return _in_process("from synth.render.mitsuba.adapter import pick; print(pick('auto'))", SULCUS_LLVM="")


def _no_llvm_asked(seed: int) -> dict[str, Any]:
    return _in_process("from synth.render.mitsuba.adapter import pick; pick('llvm_ad_rgb')", SULCUS_LLVM="")


def _no_cuda(seed: int) -> dict[str, Any]:
    return _in_process("from synth.render.mitsuba.adapter import pick; pick('cuda_ad_rgb')")


def _full_disk(seed: int) -> dict[str, Any]:
    """The renderer writes nothing itself; the machine's full device says what its caller gets."""
    shot = case(_job(seed), 0)
    rgb = shot.studio.frame(shot.vertices, shot.tips, shot.shafts, 0).rgb
    try:
        with open("/dev/full", "wb", buffering=0) as full:
            full.write(rgb.tobytes())
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise UserError(f"disk full: {error.strerror}") from error
        raise
    raise AssertionError("a full disk took a frame")


_TRIALS: dict[str, Callable[[int], dict[str, Any]]] = {
    "steep fold": _steep,
    "grazing tilt 60 deg": lambda seed: _render(seed, tilt_deg=60.0),
    "tilt 85 deg": lambda seed: _render(seed, tilt_deg=85.0),
    "tool fills the view": _filled_view,
    "tool past the lens": _behind,
    "aperture 30 mm (defocus)": lambda seed: _render(seed, aperture_mm=30.0),
    "over-exposure": _overexposed,
    "pinhole": lambda seed: _render(seed, aperture_mm=0.0),
    "strong distortion": lambda seed: _render(seed, distortion=(-8.0, 30.0, 0.02, -0.02, 0.0)),
    "folding distortion": lambda seed: _render(seed, distortion=(-200.0, 0.0, 0.0, 0.0, 0.0)),
    "spp 1": lambda seed: _render(seed, spp=1),
    "16 x 16 frame": lambda seed: _render(seed, size=(16, 16)),
    "3840 x 2160 frame": lambda seed: _render(seed, size=(3840, 2160), spp=1),
    "200k vertices": lambda seed: checked(case(_job(seed, anatomy={"vertices": 200_000}), 0)),
    "400 vertices": lambda seed: checked(case(_job(seed, anatomy={"vertices": 400}), 0)),
    "degenerate faces": _degenerate,
    "degenerate uv": _flat_maps,
    "drifting, vibrating microscope": _swaying,
    "calibration that is none": _no_calibration,
    "glare over everything": lambda seed: checked(case(_job(seed, light={"glare": 1.0}), 0)),
    "codec at 20 kbit/s": _starved,
    "surface outside the picture": _empty,
    "no surface under the opening": _holes,
    "no LLVM, auto": _no_llvm,
    "no LLVM, asked for": _no_llvm_asked,
    "no CUDA, asked for": _no_cuda,
    "full disk": _full_disk,
}
