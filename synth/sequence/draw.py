"""The draw of one sequence: all that is random in it and all that is placed, once, from (job, index)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.random import SeedSequence

from synth.arguments import checked
from synth.errors import UserError, as_user_error
from synth.fem.motion import TimeScheme
from synth.flow.stereo.calibration import read_rig
from synth.flow.stereo.rig import Rectified, StereoRig
from synth.geometry.skull import Attachment, Craniotomy
from synth.job.reader import as_job
from synth.job.schema import AnatomySection, FemSection, Job, RenderSection
from synth.render.camera import camera as cameras
from synth.render.camera import camera_calibration
from synth.render.camera.camera import Camera, Lens, visible_radius
from synth.render.idle import draw_idle
from synth.render.randomized.surroundings import Randomization
from synth.sequence import randomization, scenario
from synth.sequence.job_instruments import read_job_instruments
from synth.sequence.scenario import Scenario
from synth.system import camera_file

_ANATOMY, _SEQUENCE = 0, 1  # first element of the spawn key
_TISSUE, _GESTURE, _APPEARANCE, _VIEW, _NOISE, _FURTHER, _LABELS, _CAMERA_MOTION, _PULSE = range(9)
_IDLE, _CONTACT = 16, 17
_REDRAW = 32  # third element of the spawn key of further attempts


@dataclass(frozen=True)
class Draw:
    """One sequence of a job as drawn and placed, before anything is built. Made by `draw`."""

    index: int
    """Number of the sequence in the job."""
    dataset: Job
    """The job of all sequences, as given."""
    job: Job
    """The job with the keys that it randomises as drawn for this sequence."""
    scenario: Scenario
    """All numbers drawn for it."""
    camera: Camera
    """The microscope at rest."""
    right: Callable[[Camera], Camera] | None
    """The right camera of the left one in any pose; None without one."""
    craniotomy: Craniotomy | None
    """Where a given surface is opened; None for a procedural block, which is opened in its centre."""
    attachments: tuple[Attachment, ...]
    """What holds the tissue inside, in the surface's own axes."""
    frame_seeds: tuple[int, ...] = field(repr=False)
    """One a frame, for light paths and sensor noise, so that noise differs between frames."""
    label_seed: SeedSequence = field(repr=False, compare=False)
    """Of the noise of the published labels."""

    @property
    def opening_mm(self) -> float:
        """Radius of the opening in the skull."""
        return self.job.anatomy.craniotomy.radius_mm

    @property
    def scale(self) -> float:
        """Of the tissue: mm in a mm of the patch as it is grown and painted."""
        randomized = self.scenario.randomized
        return 1.0 if randomized is None else randomized.scale

    @property
    def scheme(self) -> TimeScheme:
        """How the tissue follows its load in time."""
        return read_scheme(self.job.fem)


def draw(job: Job, index: int, attempt: int = 0, *, case: Scenario | None = None) -> Draw:
    """Draws sequence `index` of a job, independently of the others' number and order, and places it.

    Args:
        job: the job.
        index: number of the sequence, from 0.
        attempt: number of earlier draws of its gestures; all else is the same in every attempt but idle
            instruments, which keep away from them.
        case: a scenario instead of the drawn one.

    Raises:
        UserError: instruments that don't fit, no picture in a folder of photographs, a calibration that
            cannot be used.
    """
    if index < 0:
        raise UserError(f"index {index}: sequences are numbered from 0")
    read_job_instruments(job.fem)  # those that can't be drawn are refused before anything is computed
    dataset, (job, randomized, off_centre) = job, randomization.randomize(job, index)
    lens = read_lens(job.render)

    def seed(*key: int) -> SeedSequence:
        return SeedSequence(job.seed, spawn_key=(_SEQUENCE, index, *key))

    def generator(*key: int) -> np.random.Generator:
        return np.random.default_rng(seed(*key))

    if case is None:
        case, camera = _draw_case(job, (index, attempt), lens, (randomized, off_centre), generator)
    else:
        camera = cameras.place(case.view, lens)
    if lens.K is not None:
        case = replace(case, view=cameras.state_field(case.view, camera))
    if job.mechanics.source is not None:  # whose files hold motion and load
        external_tissue = replace(case.tissue, law="external", why="mechanics.source", membrane=None)
        case = replace(case, gestures=(), pulse=None, tissue=external_tissue)
    craniotomy, attachments = open_skull(job.anatomy, case.index)
    return Draw(
        index=index,
        dataset=dataset,
        job=job,
        scenario=case,
        camera=camera,
        right=place_right(job.render, camera),
        craniotomy=craniotomy,
        attachments=attachments,
        frame_seeds=tuple(seed(_NOISE).generate_state(job.frames).tolist()),
        label_seed=seed(_LABELS),
    )


def _draw_case(
    job: Job,
    number: tuple[int, int],
    lens: Lens,
    variation: tuple[Randomization | None, tuple[float, float]],
    generator: Callable[..., np.random.Generator],
) -> tuple[Scenario, Camera]:
    """A sequence's scenario, and its camera.

    `number`: index and attempt; `variation`: of `randomization.randomize`; `generator`: of the numbers of a
    sequence's part.
    """
    index, attempt = number
    randomized, off_centre = variation
    family = job.appearance.families[index % len(job.appearance.families)]
    fem = job.fem.of_contact(scenario.choose(generator(_CONTACT), job.fem.contact))
    relief = np.random.default_rng(SeedSequence(job.seed, spawn_key=(_ANATOMY, index, 0)))
    case = Scenario(
        index=index,
        family=family,
        relief=scenario.draw_relief(job.anatomy, relief),
        tissue=scenario.draw_tissue(fem, generator(_TISSUE)),
        gestures=(),
        view=scenario.draw_view(job.render, generator(_VIEW)),
        camera_motion=scenario.draw_camera_motion(job.render, generator(_CAMERA_MOTION)),
        pulse=scenario.draw_pulse(job.fem.pulse, generator(_PULSE)),
        appearance=scenario.draw_appearance(job, family, generator(_APPEARANCE)),
        randomized=randomized,
        attempt=attempt,
    )
    view, appearance = randomization.vary(case.view, case.appearance, job, index, lens, off_centre)
    camera = cameras.place(view, lens)
    visible_mm, opening_mm = visible_radius(camera), job.anatomy.craniotomy.radius_mm
    redraw_key = (_REDRAW, attempt) if attempt else ()
    rngs = generator(*redraw_key, _GESTURE), generator(*redraw_key, _FURTHER)
    sight = visible_mm, camera.centre
    young_kpa = case.tissue.young_kpa
    gestures = scenario.draw_gestures(fem, opening_mm, young_kpa, *rngs, *sight, job.frames)
    lines = [[(*gesture.point_mm, 0.0), gesture.shaft] for gesture in gestures]
    acting = np.array(lines).reshape(-1, 2, 3)
    strength = job.randomize.get("instruments", 0.0)
    idle = draw_idle(strength, generator(_IDLE), opening_mm, visible_mm, acting)
    return replace(case, view=view, appearance=appearance, gestures=gestures, idle=idle), camera


@checked
def draw_scenario(job: Job | str | Path, index: int, attempt: int = 0) -> Scenario:
    """Draws sequence `index` of `job`, independently of the others' number and order.

    `attempt`: number of earlier draws of its gestures; all else is the same in every attempt
    but idle instruments, which keep away from them.
    """
    return draw(as_job(job), index, attempt).scenario


def read_lens(render: RenderSection) -> Lens:
    """The lens of a job, that of its calibration if it has one. UserError: that can't be used."""
    if render.calibration is None:
        return Lens(render.size, render.aperture_mm, render.distortion)
    K, distortion = camera_calibration.read(render.calibration, render.size)
    return Lens(render.size, render.aperture_mm, tuple(distortion.tolist()), K)


def read_scheme(fem: FemSection) -> TimeScheme:
    """How the tissue of a job follows its load in time."""
    return TimeScheme(fem.time, fem.mass_kg, fem.relaxation)


def open_skull(anatomy: AnatomySection, index: int) -> tuple[Craniotomy | None, tuple[Attachment, ...]]:
    """The opening of sequence `index` in a given surface, None for a block, and what holds tissue inside."""
    craniotomy = anatomy.select_opening(index).craniotomy
    opening = None
    if craniotomy.point is not None and craniotomy.direction is not None:
        opening = Craniotomy(craniotomy.point, craniotomy.direction, craniotomy.radius_mm)
    attachments = (
        Attachment(attachment.point, attachment.radius_mm, attachment.normal, attachment.thickness_mm)
        for attachment in anatomy.attachments
    )
    return opening, tuple(attachments)


def refuse_unfit(render: RenderSection) -> None:
    """Raises UserError for a calibration that can't be read, or whose cameras don't show the opening."""
    if render.calibration is not None:
        view = scenario.draw_view(render, np.random.default_rng(0))
        place_right(render, cameras.place(view, read_lens(render)))


def place_right(render: RenderSection, camera: Camera) -> Callable[[Camera], Camera] | None:
    """The right camera of the left one in any pose: parallel to it, or of a stereo calibration.

    `camera`: the left one at rest. None without a right camera. Raises UserError for a pair that is none, or
    whose right camera does not show the opening's centre.
    """
    if not render.stereo_mm:
        return None
    if render.calibration is None or not camera_file.find_baseline_mm(render.calibration):
        return partial(cameras.right_camera, baseline_mm=render.stereo_mm)
    with as_user_error("render.calibration"):
        pair = read_rig(render.calibration, render.size)
    distortion = camera_calibration.trim_distortion(pair.right.distortion, render.calibration)
    Rectified(pair)  # refuses a right camera that is not to the right
    place = partial(_place_pair, pair=pair, distortion=distortion)
    right = place(camera)
    pixel = cameras.project(right, np.zeros((1, 3)))[0]
    if right.translation[2] <= 0 or (pixel < 0).any() or (pixel >= right.size).any():
        raise UserError(
            f"render.calibration: the opening, {camera.translation[2]:.4g} mm away, is at ({pixel[0]:.0f}, "
            f"{pixel[1]:.0f}) px for the right camera, outside its picture; change render.working_distance_mm"
        )
    return place


def _place_pair(camera: Camera, pair: StereoRig, distortion: np.ndarray) -> Camera:
    """The right camera of a calibrated pair; the left one's picture may have another size than the pair's."""
    scale = np.diag(camera.K)[:2] / np.diag(pair.left.K)[:2]
    K = camera_calibration.scale_intrinsics(pair.right.K, scale)
    return cameras.place_right(
        camera, K=K, distortion=distortion, rotation=pair.rotation, translation=pair.translation
    )
