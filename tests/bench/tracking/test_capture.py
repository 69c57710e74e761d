"""A camera as a stream, by a stand-in for OpenCV's: the latest picture, its number and its time."""

import itertools
import os
import queue
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.tracking.capture import Camera, is_camera
from synth.errors import UserError


class FakeCapture:
    """Gives a picture of the red level of its number for each that is put into its queue, and then none."""

    opens = True

    def __init__(self, source: object) -> None:
        self.source, self.number, self.released = source, 0, False
        self.due = queue.Queue[bool]()

    def read(self) -> tuple[bool, Any]:
        if self.number:
            self.due.task_done()  # the one before has been kept
        good = self.due.get()
        self.number += 1
        if not good:
            self.due.put(False)
        return good, np.full((24, 32, 3), (0, 0, self.number), np.uint8)

    def give(self, count: int) -> None:
        """Lets so many pictures arrive; returns when the camera has kept all but perhaps the last."""
        for _ in range(count):
            self.due.put(True)
        while self.due.unfinished_tasks > 1:
            os.sched_yield()

    def isOpened(self) -> bool:
        return self.opens

    def get(self, key: int) -> float:
        return 50.0 if key == cv2.CAP_PROP_FPS else 0.0

    def set(self, key: int, value: float) -> None:
        assert value == 1, "pictures must not queue in the driver"

    def release(self) -> None:
        self.released = True


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> Camera:
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    ticks = itertools.count()
    return Camera(Path("2"), clock=lambda: float(next(ticks)))


def test_the_latest_picture_is_given_with_its_number_and_its_time(camera: Camera) -> None:
    capture = camera._capture
    assert (capture.source, camera.period_s) == (2, 0.02)
    pictures = camera.pictures()
    capture.give(4)
    first = next(pictures)
    assert first.index in (2, 3), "the first ones are left out"
    assert (first.time_s, *first.rgb[0, 0]) == (first.index, first.index + 1, 0, 0)
    capture.give(1)
    later = [first.index, next(pictures).index]
    capture.due.put(False)
    later += [picture.index for picture in pictures]
    assert later in ([2, 3, 4], [2, 4], [3, 4])
    camera.close()
    assert capture.released


def test_a_camera_without_pictures_is_refused(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    camera._capture.due.put(False)
    with pytest.raises(UserError, match="2: "):
        next(camera.pictures())
    monkeypatch.setattr(FakeCapture, "opens", False)
    with pytest.raises(UserError, match="video9"):
        Camera(Path("/dev/video9"))


@pytest.mark.parametrize(
    "picture", [np.zeros((24, 32, 5), np.uint8), np.broadcast_to(np.uint8(0), (8000, 8000, 3))]
)
def test_a_fault_in_the_reader_ends_the_stream(
    picture: np.ndarray[Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeCapture, "read", lambda self: (True, picture))
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    faulty_camera = Camera(Path("2"))
    faulty_camera._thread.join(5)
    assert faulty_camera._ends
    with pytest.raises(UserError):
        next(faulty_camera.pictures())


def test_names_of_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("1").touch()
    os.mkfifo("pipe")
    cameras = {name: is_camera(Path(name)) for name in ("0", "1", "a.mp4", "pipe", "/dev/null", ".")}
    assert cameras == {"0": True, "1": False, "a.mp4": False, "pipe": False, "/dev/null": True, ".": False}
