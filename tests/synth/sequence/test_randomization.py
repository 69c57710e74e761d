"""Domain randomisation: each kind does what it says, measured on scenes, maps and pictures."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import skimage

from synth.arrays import Floats, Map, Pixels
from synth.errors import UserError
from synth.job.identity import identify_job
from synth.job.reader import load_job
from synth.job.schema import Job
from synth.render.appearance.light import FreeLamp, lamps
from synth.render.camera import camera
from synth.render.camera.camera_sensor import CameraSensor, record
from synth.render.camera.video_link import transmit
from synth.render.randomized.pattern import Pattern, paint
from synth.render.scene import Renderer
from synth.sequence.draw import draw, draw_scenario, read_lens
from synth.sequence.randomization import randomize
from synth.sequence.rest_scene import at_rest
from synth.sequence.scenario import Scenario

COUNT = 100
SENSOR = CameraSensor(full_well=1e9, read_noise=0.0, sharpening=0.0, bloom=0.0, vignette=0.0)


def make_job(strength: float = 1.0, *groups: str, **sections: object) -> Job:
    defaults = {"sequences": 400, "anatomy": {"vertices": 2500}, "render": {"size": [96, 72]}, "seed": 3}
    return Job.model_validate(defaults | {"randomize": dict.fromkeys(groups, strength)} | sections)


@cache
def draw_cases() -> list[tuple[Job, Scenario]]:
    job = make_job(1.0, "texture", "surroundings", "light", "camera", "field")
    draws = (draw(job, k) for k in range(COUNT))
    return [(sample.job, sample.scenario) for sample in draws]


def test_strength_0_is_the_usual_draw_and_a_group_changes_no_other() -> None:
    off_job, plain_job = (
        make_job(0.0, "texture", "surroundings", "light", "camera", "field", "instruments"),
        make_job(),
    )
    assert draw_scenario(off_job, 2) == draw_scenario(plain_job, 2)
    full_job, (drawn_job, case) = (
        make_job(1.0, "texture", "surroundings", "light", "camera", "field"),
        draw_cases()[4],
    )
    assert randomize(drawn_job, 4)[0] == drawn_job != full_job
    assert draw_scenario(drawn_job, 4) == case
    assert (
        draw_scenario(make_job(1.0, "light"), 4).appearance.light.lamps == case.appearance.light.lamps != ()
    )
    assert identify_job(full_job) != identify_job(plain_job)


@pytest.mark.parametrize("change", ["randomize.sharp=1", "randomize.light=1.5", "randomize={light: x}"])
def test_wrong_groups_end_in_one_line(change: str) -> None:
    with pytest.raises(UserError, match=r"^[^\n]*randomize\.[^\n]*$"):
        load_job("tiny", [change])


@pytest.mark.parametrize(
    ("low", "high", "measure"),
    [
        (25.0, 100.0, lambda job, case: case.view.field_mm),
        (0.25, 0.6, lambda job, case: job.anatomy.craniotomy.radius_mm / case.view.field_mm),
        (0.01, 0.27, lambda job, case: max(map(abs, case.view.off_centre))),
        (0.1, 0.9, lambda job, case: len(job.anatomy.attachments)),
        (4.0, 20.0, lambda job, case: job.anatomy.dome_mm / case.randomized.scale / 12),
        (1.5, 5.5, lambda job, case: len(case.appearance.light.lamps)),
        (8.0, 70.0, lambda job, case: max(lamp.tilt_deg for lamp in case.appearance.light.lamps)),
        (0.2, 9.0, lambda job, case: case.appearance.light.lamps[0].window_deg),
        (0.05, 2.0, lambda job, case: case.appearance.sensor.blur),
        (0.5, 0.99, lambda job, case: case.appearance.sensor.native),
        (2.5e3, 2e4, lambda job, case: case.appearance.sensor.full_well),
        (0.1, 0.6, lambda job, case: case.appearance.sensor.vignette),
        (0.35, 0.6, lambda job, case: case.appearance.sensor.curves[1][1]),  # gamma: 0.48 is usual
        (0.9, 0.999, lambda job, case: case.appearance.sensor.curves[0][3]),  # clipped below full scale
        (0.85, 1.1, lambda job, case: case.appearance.sensor.matrix[0][0]),
        (0.5, 8.0, lambda job, case: abs(case.view.focus_mm)),
    ],
)  # fmt: skip
def test_draws_are_wider_than_the_usual(low: float, high: float, measure) -> None:  # type: ignore[no-untyped-def]
    values = [measure(job, case) for job, case in draw_cases()]
    assert min(values) < low < high < max(values)


def test_contacts_are_in_view_and_kinds_are_all_drawn() -> None:
    for job, case in draw_cases():
        lens, distance = (
            camera.place(case.view, read_lens(job.render)),
            np.array([case.view.working_distance_mm]),
        )
        assert camera.blur_radius(lens, distance)[0] < 2.6, "px, of defocus"
        pixels = camera.project(lens, np.array([(*g.point_mm, 0.0) for g in case.gestures]))
        assert ((pixels > 0) & (pixels < [95, 71])).all()
        assert sum(lamp.share for lamp in case.appearance.light.lamps) == pytest.approx(1)
    randomizations = [case.randomized for _, case in draw_cases() if case.randomized]
    sheets, coats = (
        [vars(randomization)[key] for randomization in randomizations if vars(randomization)[key]]
        for key in ("surroundings", "pattern")
    )
    assert {sheet.kind for sheet in sheets} >= {"drape", "paper", "metal", "nothing"}
    assert {coat.kind for coat in coats} >= {
        "spectrum",
        "cells",
        "speckle",
        "dots",
        "fat",
        "liver",
        "silicone",
    }
    mid_colours = np.array([coat.colours[1] for coat in coats])
    assert set(mid_colours.argmax(axis=1)) == {0, 1, 2}, "red, green and blue tissue"
    assert mid_colours.mean(axis=1).min() < 0.15 < 0.5 < mid_colours.mean(axis=1).max()
    assert (
        np.ptp([sheet.pattern.colours for sheet in sheets if sheet.kind == "metal"], axis=2).max() < 1e-12
    ), "grey"
    assert any(job.sensor.bitrate_mbps for job, _ in draw_cases())


@pytest.mark.parametrize("layout", ["hole", "corner", "edges"])
def test_tissue_is_visible_through_a_hole_in_a_corner_or_from_edge_to_edge(layout: str) -> None:
    for k, (_, case) in enumerate(draw_cases()):
        is_aside = max(map(abs, case.view.off_centre)) > 0.2
        sheet = case.randomized and case.randomized.surroundings
        is_wide = draw_cases()[k][0].anatomy.craniotomy.radius_mm / case.view.field_mm > 0.65
        if (
            (is_aside, is_wide) == (layout == "corner", layout == "edges")
            and sheet
            and sheet.kind != "nothing"
        ):
            break
    scene = at_rest(make_job(1.0, "texture", "surroundings", "light", "camera", "field"), k)
    assert scene.dataset.randomize
    content = replace(scene.renderer.content, instruments=None)
    rest = Renderer(content, scene.view).rest.tissue
    assert rest.mean() == 1 if layout == "edges" else 0.05 < rest.mean() < 0.95
    patch = Renderer(replace(content, static=()), scene.view).rest.tissue
    assert (patch >= rest).all()
    assert patch.sum() > rest.sum() or layout == "edges", "the sheet hides the patch's edge"


@pytest.mark.parametrize("kind", ["dots", "weave", "speckle", "cells", "fat"])
def test_patterns_have_their_size(kind: str) -> None:
    medians = []
    for size in (2.0, 4.0):
        frequencies, strength = measure_spectrum(
            paint(make_pattern(kind, size), 400, 40.0).albedo.mean(axis=2), 40.0
        )
        medians.append(frequencies[np.searchsorted(np.cumsum(strength), 0.5 * strength.sum())])
    assert 0.4 < 2.0 * medians[0] < 2.5
    assert 0.35 < medians[1] / medians[0] < 0.75


@pytest.mark.parametrize("slope", [0.5, 1.5])
def test_spectra_fall_with_their_slope(slope: float) -> None:
    frequencies, power = measure_spectrum(
        paint(make_pattern("spectrum", 400.0, slope), 256, 40.0).albedo.mean(axis=2), 40.0
    )
    band = (frequencies > 0.1) & (frequencies < 1.5)
    fall, _ = np.polyfit(np.log(frequencies[band]), np.log(power[band] / frequencies[band]), 1)
    assert -fall / 2 == pytest.approx(slope, abs=0.35)


def test_a_folder_gives_each_sequence_a_picture_and_a_broken_one_ends_in_a_line(tmp_path: Path) -> None:
    (empty := tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"^[^\n]*appearance\.photo[^\n]*no picture[^\n]*$"):
        load_job("tiny", [f"appearance.photo={empty}"])
    for name in (names := {"coffee.png", "astronaut.png", "chelsea.png"}):
        (tmp_path / name).write_bytes((Path(skimage.__file__).parent / "data" / name).read_bytes())
    job = make_job(appearance={"photo": tmp_path})
    assert {randomize(job, k)[0].appearance.photo.name for k in range(12)} == names  # type: ignore[union-attr]
    old_identity = identify_job(job)
    for name in names:
        (tmp_path / name).write_bytes(b"none")
    assert identify_job(job) != old_identity
    with pytest.raises(UserError, match=r"^appearance\.photo: [^\n]*$"):
        _ = at_rest(job).renderer


def test_lamps_are_where_they_are_drawn_never_below_the_horizon() -> None:
    (_, case), usual_job = draw_cases()[0], make_job()
    for tilt in (3.0, 60.0, 85.0):
        view = camera.place(replace(case.view, tilt_deg=20.0), read_lens(usual_job.render))
        free_lamp = FreeLamp(tilt, 40.0, 1.0, (1.0, 1.0, 1.0), 0.5)
        (lamp,) = lamps(view, replace(case.appearance.light, lamps=(free_lamp,), power=1.0))
        distance = np.linalg.norm(lamp.position)
        lean = np.degrees(np.arccos(lamp.position @ view.centre / distance / np.linalg.norm(view.centre)))
        assert lean == pytest.approx(tilt, abs=0.1) or lamp.position[2] == pytest.approx(0.17 * distance)
        assert lamp.radius == pytest.approx(distance * np.tan(np.radians(0.5)))


@pytest.mark.parametrize(("changes", "share"), [({"blur": 2.0}, 0.05), ({"native": 0.4}, 0.3)])
def test_blur_and_fewer_pixels_take_the_highest_frequencies(changes: dict[str, float], share: float) -> None:
    radiance = np.repeat(np.random.default_rng(0).uniform(0.1, 0.9, (96, 96, 1)), 3, 2).astype(np.float32)
    spectra = [
        measure_spectrum(take_picture(radiance, sensor).mean(axis=2), 96.0)
        for sensor in (SENSOR, replace(SENSOR, **changes))  # type: ignore[arg-type]
    ]
    sharp_power, soft_power = (power[frequencies > 0.35].mean() for frequencies, power in spectra)
    assert soft_power < share * sharp_power


def test_halos_are_as_wide_as_drawn_and_subsampling_and_codec_take_detail() -> None:
    edge = np.full((40, 80, 3), 0.2, np.float32)
    edge[:, 40:] = 0.5
    sensors = (replace(SENSOR, sharpening=2.0, halo_px=px) for px in (1.0, 3.0))
    rows = [take_picture(edge, sensor)[20, 40:, 1].astype(int) for sensor in sensors]
    narrow, wide = ((row - row[-1] > 2).sum() for row in rows)
    assert wide > 2 * narrow > 0
    parity = np.indices((72, 96)).sum(axis=0)[..., None] % 2
    checks = np.where(parity, (0.6, 0.2, 0.2), (0.2, 0.2, 0.6)).astype(np.float32)
    full, half = (
        np.ptp(take_picture(checks, replace(SENSOR, chroma=chroma))[..., 0]) for chroma in ("4:4:4", "4:2:0")
    )
    assert half < 0.6 * full
    noisy = np.random.default_rng(1).integers(0, 255, (3, 72, 96, 3), dtype=np.uint8)
    coded_job = min((job for job, _ in draw_cases()), key=lambda job: job.sensor.bitrate_mbps or 9)
    assert (
        np.abs(
            transmit(noisy, coded_job.fps, coded_job.sensor.bitrate_mbps, coded_job.sensor.chroma).astype(int)
            - noisy
        ).mean()
        > 10
    )


def make_pattern(kind: str, size: float, slope: float = 1.0) -> Pattern:
    return Pattern(kind, ((0.05,) * 3, (0.4,) * 3, (0.8,) * 3), size, slope, 0.0, 0.5, 0.1, seed=5)  # type: ignore[arg-type]


def take_picture(radiance: Map, sensor: CameraSensor) -> Pixels:
    return record(radiance, sensor, np.random.default_rng(0))


def measure_spectrum(image: Map, extent: float) -> tuple[Floats, Floats]:
    """Frequencies [1/mm] and the power in rings around 0."""
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    step = np.fft.fftfreq(len(image), 1 / len(image))
    rings = np.rint(np.hypot(step[:, None], step)).astype(int)
    total = np.bincount(rings.ravel(), power.ravel())[1 : len(image) // 2]
    return np.arange(1, len(total) + 1) / extent, total
