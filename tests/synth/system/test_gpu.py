"""Drivers and GPUs that the renderer can use."""

import pytest

from synth.system.gpu import Gpu, obstacle


@pytest.mark.parametrize(
    ("gpu", "is_usable"),
    [
        (None, False),
        (Gpu(1, "550.54.14", (9, 0), optix=True), True),
        (Gpu(1, "550.54.14", (9, 0), optix=False), False),  # a container without the graphics capability
        (Gpu(1, "525.147.05", (8, 6), optix=True), False),
        (Gpu(1, "565.57.01", (8, 9), optix=True), False),
        (Gpu(1, "570.133.20", (12, 0), optix=True), True),
        (Gpu(1, "550.54.14", (7, 0), optix=True), False),
        (Gpu(1, "", (8, 0), optix=True), True),  # an unknown driver is tried
    ],
)
def test_drivers_and_devices_that_the_renderer_runs_on(gpu: Gpu | None, is_usable: bool) -> None:
    assert (obstacle(gpu) is None) is is_usable
