"""Pulsation of the tissue: found where there is one, not found in contacts or noise alone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from synth.flow.recording.find_pulse import PulseEstimate, SurfaceMotion, find_pulse

SIZE = (120, 160)
MM_PER_PX = 0.16
Y, X = (np.mgrid[: SIZE[0], : SIZE[1]] - np.array(SIZE)[:, None, None] / 2) / 80
HEART = np.stack([0.8 - 0.3 * (X**2 + Y**2), 0.5 + 0.3 * Y], axis=-1)
BREATH = np.stack([-0.2 + 0.3 * X, 0.9 + 0.2 * Y], axis=-1)
SQUARED_DISTANCE = (X - 0.2) ** 2 + (Y + 0.1) ** 2
CONTACT = np.stack(
    [
        np.exp(-SQUARED_DISTANCE / 0.05) + 0.1 / (1 + 4 * SQUARED_DISTANCE),
        0.3 * np.exp(-SQUARED_DISTANCE / 0.08),
    ],
    axis=-1,
)


def simulate(
    seconds: float = 20.0,
    heart_mm: float = 0.4,
    breath_mm: float = 0.25,
    contact_mm: float = 1.5,
    period_s: float | None = None,
    wander: float = 0.0,
    rest_px: float = 0.0,
) -> tuple[SurfaceMotion, NDArray[np.float64], list[NDArray[np.float64]]]:
    """Tracked motion, its times, and the pulsation with the noise of the rest frame [px]."""
    rng = np.random.default_rng(0)
    time = np.arange(0, seconds, 0.1) + rng.uniform(-0.02, 0.02, round(10 * seconds))
    load = np.clip(np.sin(2 * np.pi * time / period_s), 0, None) if period_s else np.zeros_like(time)
    begin_s = seconds if period_s else 2.0  # irregular contacts, where none are periodic
    while begin_s < seconds - 2:
        duration_s = rng.uniform(1, 2.5)
        in_contact = (time > begin_s) & (time < begin_s + duration_s)
        load += in_contact * rng.uniform(0.5, 1) * np.sin(np.pi * (time - begin_s) / duration_s)
        begin_s += duration_s + rng.uniform(0.8, 2.5)
    surface, pulsations = SurfaceMotion(np.ones(SIZE, bool)), []
    rest_noise = rng.normal(0, rest_px, (SIZE[0] // 8, SIZE[1] // 8, 2)).repeat(8, 0).repeat(8, 1)
    for t, force in zip(time, load, strict=True):
        phase = 2 * np.pi * 1.2 * t + wander * np.sin(2 * np.pi * t / seconds)
        heart = heart_mm * (np.sin(phase) + 0.3 * np.sin(2 * phase)) * HEART
        pulsation = (heart + breath_mm * np.sin(2 * np.pi * 0.25 * t + 1) * BREATH) / MM_PER_PX
        pulsations.append(pulsation)
        noise = rng.normal(0, 0.05, (SIZE[0] // 8, SIZE[1] // 8, 2)).repeat(8, 0).repeat(8, 1)
        flow = pulsation - pulsations[0] + force * contact_mm / MM_PER_PX * CONTACT + noise + rest_noise
        surface.add(float(t), flow.astype(np.float32), np.ones(SIZE, np.float32))
    return surface, time, [pulsation - pulsations[0] + rest_noise for pulsation in pulsations]


def measure_error_mm(
    pulse: PulseEstimate, time: NDArray[np.float64], truth: list[NDArray[np.float64]]
) -> float:
    """Root mean square error of the pulsation [mm]."""
    squares = [np.square(pulse.at(t) - pulsation).mean() for t, pulsation in zip(time, truth, strict=True)]
    return MM_PER_PX * float(np.sqrt(np.mean(squares)))


@pytest.mark.slow
def test_heart_and_breath_between_contacts_are_found() -> None:
    surface, time, truth = simulate()
    for free_s in ([(0.0, 0.3)], []):  # a stated span that is too short does no harm
        pulse = find_pulse(surface, time[0], free_s).pulse
        assert [rhythm.rate_hz for rhythm in pulse.rhythms] == pytest.approx([1.2, 0.25], rel=0.01)
    assert measure_error_mm(pulse, time, truth) < 0.01
    # The amplitude of the heart by definition: half of the peak-to-peak motion.
    phase = np.linspace(0, 2 * np.pi, 200)
    wave = np.ptp(np.sin(phase) + 0.3 * np.sin(2 * phase)) / 2
    expected = 0.4 * wave * np.median(np.linalg.norm(HEART, axis=-1))
    assert MM_PER_PX * pulse.amplitudes_px[0] == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
def test_noise_of_the_rest_frame_is_removed_up_to_a_limit() -> None:
    surface, time, truth = simulate(rest_px=0.06)
    pulse = find_pulse(surface, time[0]).pulse
    uncorrected_pulse = replace(pulse, rest_noise=0 * pulse.rest_noise)
    assert measure_error_mm(pulse, time, truth) < 0.7 * measure_error_mm(uncorrected_pulse, time, truth)
    surface, time, _ = simulate(rest_px=0.5)
    pulse = find_pulse(surface, time[0]).pulse
    assert np.linalg.norm(pulse.rest_noise, axis=-1).max() == pytest.approx(0.15, abs=0.01)


@pytest.mark.parametrize("period_s", [None, 2.0, 0.9])
def test_contacts_alone_are_no_pulse_even_if_periodic(period_s: float | None) -> None:
    surface, time, _ = simulate(heart_mm=0.0, breath_mm=0.0, period_s=period_s)
    assert find_pulse(surface, float(time[0])).pulse is None


def test_noise_alone_and_a_short_video_give_no_pulse() -> None:
    surface, time, _ = simulate(heart_mm=0.0, breath_mm=0.0, contact_mm=0.0)
    assert find_pulse(surface, float(time[0])).pulse is None
    surface, time, _ = simulate(seconds=2.5)
    result = find_pulse(surface, float(time[0]))
    assert (result.pulse, len(result.free_s), result.rates_hz) == (None, 25, None)


@pytest.mark.parametrize("case", ["hidden at times", "never visible", "still"])
def test_too_little_tissue_or_motion_is_no_pulse(case: str) -> None:
    surface, rng = SurfaceMotion(np.ones((96, 128), bool)), np.random.default_rng(0)
    for k in range(60):
        visible = case == "still" or (case == "hidden at times" and k % 5 > 0)
        motion = (case != "still") * rng.normal(0, 0.1, (96, 128, 2)).astype(np.float32)
        surface.add(k / 10, motion, np.full((96, 128), visible, np.float32))
    assert find_pulse(surface, 0.0).pulse is None
