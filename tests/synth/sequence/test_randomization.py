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


def job(strength: float = 1.0, *groups: str, **more: object) -> Job:
    given = {"sequences": 400, "anatomy": {"vertices": 2500}, "render": {"size": [96, 72]}, "seed": 3}
    return Job.model_validate(given | {"randomize": dict.fromkeys(groups, strength)} | more)


@cache
def drawn() -> list[tuple[Job, Scenario]]:
    whole = job(1.0, "texture", "surroundings", "light", "camera", "field")
    drawn = (draw(whole, k) for k in range(COUNT))
    return [(one.job, one.scenario) for one in drawn]


def test_strength_0_is_the_usual_draw_and_a_group_changes_no_other() -> None:
    off, plain = job(0.0, "texture", "surroundings", "light", "camera", "field", "instruments"), job()
    assert draw_scenario(off, 2) == draw_scenario(plain, 2)
    full, (once, case) = job(1.0, "texture", "surroundings", "light", "camera", "field"), drawn()[4]
    assert randomize(once, 4)[0] == once != full
    assert draw_scenario(once, 4) == case
    assert draw_scenario(job(1.0, "light"), 4).appearance.light.lamps == case.appearance.light.lamps != ()
    assert identify_job(full) != identify_job(plain)


@pytest.mark.parametrize("change", ["randomize.sharp=1", "randomize.light=1.5", "randomize={light: x}"])
def test_wrong_groups_end_in_one_line(change: str) -> None:
    with pytest.raises(UserError, match=r"^[^\n]*randomize\.[^\n]*$"):
        load_job("tiny", [change])


@pytest.mark.parametrize(
    ("low", "high", "of"),
    [
        (25.0, 100.0, lambda one, case: case.view.field_mm),
        (0.25, 0.6, lambda one, case: one.anatomy.craniotomy.radius_mm / case.view.field_mm),
        (0.01, 0.27, lambda one, case: max(map(abs, case.view.off_centre))),
        (0.1, 0.9, lambda one, case: len(one.anatomy.attachments)),
        (4.0, 20.0, lambda one, case: one.anatomy.dome_mm / case.randomized.scale / 12),
        (1.5, 5.5, lambda one, case: len(case.appearance.light.lamps)),
        (8.0, 70.0, lambda one, case: max(lamp.tilt_deg for lamp in case.appearance.light.lamps)),
        (0.2, 9.0, lambda one, case: case.appearance.light.lamps[0].window_deg),
        (0.05, 2.0, lambda one, case: case.appearance.sensor.blur),
        (0.5, 0.99, lambda one, case: case.appearance.sensor.native),
        (2.5e3, 2e4, lambda one, case: case.appearance.sensor.full_well),
        (0.1, 0.6, lambda one, case: case.appearance.sensor.vignette),
        (0.35, 0.6, lambda one, case: case.appearance.sensor.curves[1][1]),  # gamma: 0.48 is usual
        (0.9, 0.999, lambda one, case: case.appearance.sensor.curves[0][3]),  # clipped below full scale
        (0.85, 1.1, lambda one, case: case.appearance.sensor.matrix[0][0]),
        (0.5, 8.0, lambda one, case: abs(case.view.focus_mm)),
    ],
)  # fmt: skip
def test_draws_are_wider_than_the_usual(low: float, high: float, of) -> None:  # type: ignore[no-untyped-def]
    values = [of(one, case) for one, case in drawn()]
    assert min(values) < low < high < max(values)


def test_contacts_are_in_view_and_kinds_are_all_drawn() -> None:
    for one, case in drawn():
        lens, away = camera.place(case.view, read_lens(one.render)), np.array([case.view.working_distance_mm])
        assert camera.blur_radius(lens, away)[0] < 2.6, "px, of defocus"
        at = camera.project(lens, np.array([(*g.point_mm, 0.0) for g in case.gestures]))
        assert ((at > 0) & (at < [95, 71])).all()
        assert sum(lamp.share for lamp in case.appearance.light.lamps) == pytest.approx(1)
    hows = [case.randomized for _, case in drawn() if case.randomized]
    sheets, coats = ([vars(how)[of] for how in hows if vars(how)[of]] for of in ("surroundings", "pattern"))
    assert {one.kind for one in sheets} >= {"drape", "paper", "metal", "nothing"}
    assert {one.kind for one in coats} >= {"spectrum", "cells", "speckle", "dots", "fat", "liver", "silicone"}
    middle = np.array([one.colours[1] for one in coats])
    assert set(middle.argmax(axis=1)) == {0, 1, 2}, "red, green and blue tissue"
    assert middle.mean(axis=1).min() < 0.15 < 0.5 < middle.mean(axis=1).max()
    assert np.ptp([one.pattern.colours for one in sheets if one.kind == "metal"], axis=2).max() < 1e-12, (
        "grey"
    )
    assert any(one.sensor.bitrate_mbps for one, _ in drawn())


@pytest.mark.parametrize("layout", ["hole", "corner", "edges"])
def test_tissue_is_visible_through_a_hole_in_a_corner_or_from_edge_to_edge(layout: str) -> None:
    for k, (_, case) in enumerate(drawn()):
        aside = max(map(abs, case.view.off_centre)) > 0.2
        sheet = case.randomized and case.randomized.surroundings
        wide = drawn()[k][0].anatomy.craniotomy.radius_mm / case.view.field_mm > 0.65
        if (aside, wide) == (layout == "corner", layout == "edges") and sheet and sheet.kind != "nothing":
            break
    scene = at_rest(job(1.0, "texture", "surroundings", "light", "camera", "field"), k)
    assert scene.dataset.randomize
    content = replace(scene.renderer.content, instruments=None)
    rest = Renderer(content, scene.view).rest.tissue
    assert rest.mean() == 1 if layout == "edges" else 0.05 < rest.mean() < 0.95
    patch = Renderer(replace(content, static=()), scene.view).rest.tissue
    assert (patch >= rest).all()
    assert patch.sum() > rest.sum() or layout == "edges", "the sheet hides the patch's edge"


@pytest.mark.parametrize("kind", ["dots", "weave", "speckle", "cells", "fat"])
def test_patterns_have_their_size(kind: str) -> None:
    middle = []
    for size in (2.0, 4.0):
        away, strength = spectrum(paint(pattern(kind, size), 400, 40.0).albedo.mean(axis=2), 40.0)
        middle.append(away[np.searchsorted(np.cumsum(strength), 0.5 * strength.sum())])
    assert 0.4 < 2.0 * middle[0] < 2.5
    assert 0.35 < middle[1] / middle[0] < 0.75


@pytest.mark.parametrize("slope", [0.5, 1.5])
def test_spectra_fall_with_their_slope(slope: float) -> None:
    away, power = spectrum(paint(pattern("spectrum", 400.0, slope), 256, 40.0).albedo.mean(axis=2), 40.0)
    band = (away > 0.1) & (away < 1.5)
    fall, _ = np.polyfit(np.log(away[band]), np.log(power[band] / away[band]), 1)
    assert -fall / 2 == pytest.approx(slope, abs=0.35)


def test_a_folder_gives_each_sequence_a_picture_and_a_broken_one_ends_in_a_line(tmp_path: Path) -> None:
    (empty := tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"^[^\n]*appearance\.photo[^\n]*no picture[^\n]*$"):
        load_job("tiny", [f"appearance.photo={empty}"])
    for name in (names := {"coffee.png", "astronaut.png", "chelsea.png"}):
        (tmp_path / name).write_bytes((Path(skimage.__file__).parent / "data" / name).read_bytes())
    given = job(appearance={"photo": tmp_path})
    assert {randomize(given, k)[0].appearance.photo.name for k in range(12)} == names  # type: ignore[union-attr]
    before = identify_job(given)
    for name in names:
        (tmp_path / name).write_bytes(b"none")
    assert identify_job(given) != before
    with pytest.raises(UserError, match=r"^appearance\.photo: [^\n]*$"):
        _ = at_rest(given).renderer


def test_lamps_are_where_they_are_drawn_never_below_the_horizon() -> None:
    (_, case), usual = drawn()[0], job()
    for tilt in (3.0, 60.0, 85.0):
        view = camera.place(replace(case.view, tilt_deg=20.0), read_lens(usual.render))
        one = FreeLamp(tilt, 40.0, 1.0, (1.0, 1.0, 1.0), 0.5)
        (lamp,) = lamps(view, replace(case.appearance.light, lamps=(one,), power=1.0))
        away = np.linalg.norm(lamp.position)
        lean = np.degrees(np.arccos(lamp.position @ view.centre / away / np.linalg.norm(view.centre)))
        assert lean == pytest.approx(tilt, abs=0.1) or lamp.position[2] == pytest.approx(0.17 * away)
        assert lamp.radius == pytest.approx(away * np.tan(np.radians(0.5)))


@pytest.mark.parametrize(("soft", "share"), [({"blur": 2.0}, 0.05), ({"native": 0.4}, 0.3)])
def test_blur_and_fewer_pixels_take_the_highest_frequencies(soft: dict[str, float], share: float) -> None:
    fine = np.repeat(np.random.default_rng(0).uniform(0.1, 0.9, (96, 96, 1)), 3, 2).astype(np.float32)
    spectra = [spectrum(taken(fine, one).mean(axis=2), 96.0) for one in (SENSOR, replace(SENSOR, **soft))]  # type: ignore[arg-type]
    sharp, lost = (power[away > 0.35].mean() for away, power in spectra)
    assert lost < share * sharp


def test_halos_are_as_wide_as_drawn_and_subsampling_and_codec_take_detail() -> None:
    edge = np.full((40, 80, 3), 0.2, np.float32)
    edge[:, 40:] = 0.5
    sharp = (replace(SENSOR, sharpening=2.0, halo_px=px) for px in (1.0, 3.0))
    rows = [taken(edge, one)[20, 40:, 1].astype(int) for one in sharp]
    narrow, wide = ((row - row[-1] > 2).sum() for row in rows)
    assert wide > 2 * narrow > 0
    odd = np.indices((72, 96)).sum(axis=0)[..., None] % 2
    checks = np.where(odd, (0.6, 0.2, 0.2), (0.2, 0.2, 0.6)).astype(np.float32)
    full, half = (np.ptp(taken(checks, replace(SENSOR, chroma=one))[..., 0]) for one in ("4:4:4", "4:2:0"))
    assert half < 0.6 * full
    noisy = np.random.default_rng(1).integers(0, 255, (3, 72, 96, 3), dtype=np.uint8)
    coded = min((one for one, _ in drawn()), key=lambda one: one.sensor.bitrate_mbps or 9)
    assert (
        np.abs(
            transmit(noisy, coded.fps, coded.sensor.bitrate_mbps, coded.sensor.chroma).astype(int) - noisy
        ).mean()
        > 10
    )


def pattern(kind: str, size: float, slope: float = 1.0) -> Pattern:
    return Pattern(kind, ((0.05,) * 3, (0.4,) * 3, (0.8,) * 3), size, slope, 0.0, 0.5, 0.1, seed=5)  # type: ignore[arg-type]


def taken(radiance: Map, sensor: CameraSensor) -> Pixels:
    return record(radiance, sensor, np.random.default_rng(0))


def spectrum(image: Map, extent: float) -> tuple[Floats, Floats]:
    """Frequencies [1/mm] and the power in rings around 0."""
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    step = np.fft.fftfreq(len(image), 1 / len(image))
    away = np.rint(np.hypot(step[:, None], step)).astype(int)
    total = np.bincount(away.ravel(), power.ravel())[1 : len(image) // 2]
    return np.arange(1, len(total) + 1) / extent, total
