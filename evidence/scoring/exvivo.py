"""Ex vivo stand-ins: rendered recordings that differ from all training data in every respect.

They have creep under load, another appearance family, lens, field and tilt, a compressed video, hand tremor,
presses at several places, and a sensor with its own axes, clock, zero, drift and noise. The layout is that of
a real recording; they are scored by `bench score` and `bench pool`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from bench.recording import recording_writer
from evidence import report
from evidence.pooled import FOLDERS, RIGHT, copy_left, score_and_pool
from evidence.study import Study
from synth.arrays import Floats, Ints, Pixels
from synth.errors import UserError
from synth.fem import solver, tool_gesture
from synth.fem.deformation import Deformation
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.mesh_relief import HeightMap
from synth.geometry.triangles import Shape
from synth.job import schema as jobs
from synth.render.anatomy.surface import CortexSurface
from synth.render.scene import SceneState
from synth.sequence import scenario
from synth.sequence.draw import read_scheme
from synth.sequence.rest_scene import at_rest
from synth.system import checked_file
from synth.system.terminal import counting
from synth.tune.search import change_job

_GESTURES = 3
_LEVELS = 9
_SENSOR_HZ = 200.0
_STILL_S = 1.5
_STEREO_MM = 24.0
_VIDEO, _PAIR = RIGHT
_SYNC_S = 9.0
_PRESS_S = 13.0
_LATE, _LATE_S = 0.2, 0.8  # creep: delayed share of the response, and its time constant [s]


def measure(
    recordings: Path,
    count: int = 6,
    seconds: float = 30.0,
    fps: float = 10.0,
    width: int = 320,
    photo: Path | None = None,
    seed: int = 100,
    results: Path = report.RESULTS / "exvivo",
) -> None:
    """Renders ex vivo stand-ins into the folder `recordings` and scores them, with both cameras and with the
    left one alone, into `results`.

    `seconds`: length of each; `fps`: mean frames a second; `width`: of the image, 4:3; `photo`: a photograph
    as texture of the surface.
    """
    texture = photo.resolve() if photo else None
    plan = Plan(seed, seconds, fps, (width, width * 3 // 4), texture)
    folders = {
        cameras: [recordings / name / f"{index:03d}" for index in range(count)]
        for cameras, name in FOLDERS.items()
    }
    for index, (mono, stereo) in enumerate(zip(folders[1], folders[2], strict=True)):
        if not stereo.exists():
            count_frames = counting(f"recording {index}", int(seconds * fps))
            with count_frames as progress, checked_file.folder_of(stereo) as part:
                make(plan, index, part, progress)
        copy_left(stereo, mono)
    for cameras, paths in folders.items():
        score_and_pool(paths, cameras, results / FOLDERS[cameras])


@dataclass(frozen=True)
class Plan:
    """One set of recordings."""

    seed: int = 100
    seconds: float = 30.0
    fps: float = 10.0
    size: tuple[int, int] = (320, 240)
    photo: Path | None = None  # texture of the surface; None: procedural


@dataclass(frozen=True)
class _Course:
    """Motion of the hand, at the sensor's rate."""

    time_s: Floats  # (N,)
    level: Floats  # (N,) force relative to its peak
    strain: Floats  # (N,) elastic level of the same displacement: `level` after creep
    gesture: Ints  # (N,) index of the gesture
    away: Floats  # (N,) distance of the tips from the tissue, relative to the hover height


def job_of(plan: Plan) -> jobs.Job:
    """The job of the recordings, with unusual settings."""
    return jobs.Job.model_validate(
        {
            "seed": plan.seed,
            "sequences": 1000,
            "frames": 2 * _LEVELS,
            "fps": plan.fps,
            "appearance": {"families": ["calf"], "photo": plan.photo},
            "anatomy": {
                "gyrus_mm": [8.0, 10.0], "sulcus_mm": [1.0, 2.0], "dome_mm": 60.0, "vertices": 20_000,
            },
            "fem": {
                "law": "neo-hookean", "tets": 3000, "young_kpa": [1.5, 4.0], "poisson": 0.45,
                "load": [0.15, 0.35], "footprint_mm": [4.0, 6.0],
            },
            "render": {
                "size": plan.size, "spp": 4, "field_mm": [30.0, 40.0], "tilt_deg": [5.0, 25.0],
                "working_distance_mm": [220.0, 380.0], "aperture_mm": 6.0,
                "distortion": [-0.12, 0.03, 0.001, -0.001, 0.0],
                "stereo_mm": _STEREO_MM,
            },
        }
    )  # fmt: skip


def make(plan: Plan, index: int, part: Path, progress: Callable[[int], None] = lambda done: None) -> None:
    """Renders recording `index` of a plan into the folder `part`.

    Raises:
        UserError: the recording is shorter than its calibration; or from the rendering.
    """
    if plan.seconds < _PRESS_S + 5:
        raise UserError(f"seconds: {plan.seconds:g}; calibration alone takes {_PRESS_S:g}, at least 5 more")
    (part / "masks").mkdir(parents=True)
    job = job_of(plan)
    scene = at_rest(change_job(job, {"fem.instrument_list": [{"gesture": "pull"}]}), index)
    case, surface = scene.scenario, scene.surface
    rng = np.random.default_rng([plan.seed, index, 77])
    opening, young = job.anatomy.craniotomy.radius_mm, case.tissue.young_kpa
    gestures = [scenario.draw_gesture(job.fem, opening, young, rng) for _ in range(_GESTURES)]
    motions = [_deform(job, case, gesture, surface) for gesture in gestures]
    course = _course(plan, rng)
    steps = (1 + 0.1 * rng.uniform(-1, 1, int(plan.seconds * plan.fps))) / plan.fps
    times = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
    renderer = scene.renderer
    assert renderer.right is not None
    pictures: list[tuple[Pixels, Pixels]] = []
    for k, time in enumerate(times):
        sample = int(np.searchsorted(course.time_s, time).clip(0, len(course.time_s) - 1))
        motion, gesture = motions[course.gesture[sample]], gestures[course.gesture[sample]]
        vertices, tips, shafts = _pose(scene.shape, motion, gesture, course, sample, rng)
        shot = renderer.render(SceneState(vertices, tips, shafts), int(rng.integers(2**31)))
        assert shot.rgb_right is not None
        pictures.append((shot.rgb, shot.rgb_right))
        cv2.imwrite(str(part / "masks" / f"{k:06d}.png"), shot.tool.astype(np.uint8) * 255)
        progress(k + 1)
    crf = int(rng.integers(18, 25))
    recording_writer.write_video(part / "video.mp4", (left for left, _ in pictures), times, crf=crf)
    recording_writer.write_video(part / _VIDEO, (right for _, right in pictures), times, crf=crf)
    recording_writer.write_pair(part / _PAIR, scene.view, renderer.right)
    cv2.imwrite(str(part / "tissue.png"), scene.tissue.astype(np.uint8) * 255)
    force = np.stack([g.force_mn * np.asarray(g.direction) for g in gestures])[course.gesture]
    lag = _write_sensor(part, course, force * course.level[:, None], rng)
    # Contact-free spans at both ends on the sensor's clock, as noted by an operator.
    free_s = np.array([[0.1, _STILL_S - 0.1], [plan.seconds - 0.2, plan.seconds + 0.8]]) - lag
    meta: dict[str, object] = {
        "scale_mm_per_px": float(scene.scale_mm_per_px * (1 + 0.02 * rng.normal())),
        "scale_uncertainty": 0.02,
        "young_kpa": case.tissue.young_kpa,
        "specimen": f"calf {index}",
        "press_s": [_SYNC_S, _PRESS_S],
        "sync": {"method": "correlate", "calibration_s": [0.0, _SYNC_S], "search_s": 0.7},
        "sensor": {"axes": "sensor", "low_pass_hz": 10.0, "free_s": free_s.tolist()},
        "stereo": {"calibration": _PAIR},
    }
    recording_writer.write_meta(part, meta)


def _deform(
    job: jobs.Job, case: scenario.Scenario, gesture: tool_gesture.Gesture, surface: CortexSurface
) -> Deformation:
    """Deformation from no load to full load, by a gesture that only rises."""
    rising = tool_gesture.Gesture(**{**vars(gesture), "timing": (0.02, 1.0, 2.0, 3.0)})
    height = HeightMap(surface.pia, surface.extent_mm)
    opening_mm, dome_mm = job.anatomy.craniotomy.radius_mm, job.anatomy.dome_mm
    sizes = job.fem.tets, gesture.focus, height
    tets = tetrahedra.block(*sizes, opening_mm=opening_mm, dome_mm=dome_mm)
    shape = Shape(surface.vertices, surface.faces)
    return solver.deform(read_scheme(job.fem), case.tissue, [rising], tets, shape, job.frames, job.fps)


def _course(plan: Plan, rng: np.random.Generator) -> _Course:
    """Presses of random height and duration, at rest during the first and the last seconds."""
    time = np.arange(0, plan.seconds + 1, 1 / _SENSOR_HZ)
    level, gesture, away = np.zeros_like(time), np.zeros(len(time), np.int64), np.ones_like(time)
    start, turn = _STILL_S + 0.3, 0
    while start < plan.seconds - 3.5:
        rise, hold, fall = rng.uniform(0.4, 0.9), rng.uniform(0.2, 0.9), rng.uniform(0.3, 0.8)
        end = start + rise + hold + fall
        press = ramp((time - start) / rise) * ramp((end - time) / fall)
        inside = (time > start - 0.4) & (time < end + 0.4)
        level = np.maximum(level, rng.uniform(0.4, 1.0) * press)
        gesture[time > start - 0.4] = turn % _GESTURES
        away[inside] = np.maximum(ramp((start - time) / 0.4), ramp((time - end) / 0.4))[inside]
        start = end + rng.uniform(0.9, 1.6)
        turn += 1
    tremor = 0.03 * np.sin(2 * np.pi * rng.uniform(8, 11) * time + rng.uniform(0, 6)) * level
    level = np.clip(level + tremor, 0, 1)
    return _Course(time, level, _apply_creep(time, level), gesture, away)


def _apply_creep(time_s: Floats, level: Floats) -> Floats:
    """Quasi-linear creep with one time constant (Fung): part of the response has a first-order lag."""
    share = (time_s[1] - time_s[0]) / _LATE_S
    late = lfilter([share], [1, share - 1], level)
    return np.asarray(np.clip((1 - _LATE) * level + _LATE * late, 0, 1), np.float64)


def _pose(
    rest: Shape,
    motion: Deformation,
    gesture: tool_gesture.Gesture,
    course: _Course,
    index: int,
    rng: np.random.Generator,
) -> tuple[Floats, Floats, Floats]:
    """Surface, tips and shafts, interpolated between two levels of the path, with a tremor of 0.1 mm."""
    levels = np.linalg.norm(motion.force, axis=1) / gesture.force_mn
    strain = float(course.strain[index])
    above = int(np.searchsorted(levels, strain).clip(1, len(levels) - 1))
    width = max(levels[above] - levels[above - 1], 1e-9)
    part = float(np.clip((strain - levels[above - 1]) / width, 0, 1))
    displacement = (1 - part) * motion.displacement[above - 1] + part * motion.displacement[above]
    places = tool_gesture.find_anchors(gesture, tool_gesture.trajectory(gesture, 2), rest)
    corners, weights = (array[0] for array in places)
    contact_points = np.einsum("kc,kcd->kd", weights, (rest.vertices + displacement)[corners])
    shafts = motion.shaft[-1]
    tips = contact_points + gesture.hover_mm * course.away[index] * shafts + 0.1 * rng.normal(size=(1, 3))
    return rest.vertices + displacement, tips, shafts


def _write_sensor(part: Path, course: _Course, force: Floats, rng: np.random.Generator) -> float:
    """Writes force.csv with the sensor's axes, zero, drift, noise and clock; returns the clock's lag [s]."""
    lag = float(rng.uniform(-0.5, 0.5))
    size = float(np.linalg.norm(force, axis=1).max())
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()  # uniform over rotations
    drift = size * rng.normal(size=3) * 0.002 * course.time_s[:, None]
    noise = 0.005 * size
    measured = force @ turn.T + size * rng.normal(0, 0.3, 3) + drift + noise * rng.normal(size=force.shape)
    recording_writer.write_force(part, course.time_s - lag, measured / 1000)
    return lag


def ramp(s: Floats) -> Floats:
    """Smoothstep from 0 to 1."""
    s = np.clip(s, 0, 1)
    return np.asarray(s * s * (3 - 2 * s), np.float64)


STUDY = Study(
    measure,
    "exvivo/*/pool.json",
    steps=("{work}/exvivo --photo {photo}",),
    needs=("mesh", "mechanics", "picture", "truth", "score", "score-stereo"),
)
