"""A camera as a video: pictures with the times of their arrival, always the latest one."""

from __future__ import annotations

import stat
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2

from synth.errors import UserError, first_line
from synth.system.checked_file import refuse_large
from synth.video.read_video import Picture

_FAILURES = 3  # pictures in a row that a camera fails to give before it counts as gone
_SLOWEST_S = 10.0  # longest wait for a picture


def is_camera(source: Path) -> bool:
    """Whether it is a camera: a number that is no file's name, or a device such as /dev/video0."""
    if source.exists():
        return stat.S_ISCHR(source.stat().st_mode)
    return str(source).isdecimal()


class Camera:
    """A camera that is read by a thread of its own, so that pictures never wait in a queue."""

    def __init__(self, source: Path, clock: Callable[[], float] = time.perf_counter) -> None:
        """`source`: as of `is_camera`; `clock`: of the times [s]. UserError: it can't be opened."""
        self.name, self._clock = str(source), clock
        self._capture: Any = cv2.VideoCapture(int(self.name) if self.name.isdecimal() else self.name)
        if not self._capture.isOpened():
            raise UserError(f"{self.name}: not a camera that can be opened (is another program using it?)")
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.period_s = 1 / fps if 1 <= fps <= 1000 else 0.04
        """Stated time between two pictures [s]."""
        self._latest: Picture | None = None
        self._error: Exception | None = None  # that ended the thread
        self._news, self._ends = threading.Condition(), False
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def pictures(self) -> Iterator[Picture]:
        """The latest picture whenever one is asked for, after its arrival; numbers left out were not taken.

        Ends when the camera is closed or gone. UserError: it gives no picture.
        """
        picture = self._after(-1)
        if picture is None:
            raise UserError(f"{self.name}: gives no pictures")
        while picture is not None:
            yield picture
            picture = self._after(picture.index)

    def close(self) -> None:
        """Ends the stream and releases the camera."""
        self._ends = True
        self._thread.join(_SLOWEST_S)
        self._capture.release()

    def _after(self, number: int) -> Picture | None:
        """The latest picture as soon as it is later than that of a number; None: the camera has ended.

        UserError: it gives none in time, or reading failed.
        """

        def latest() -> Picture | None:
            return self._latest if self._latest is not None and self._latest.index > number else None

        with self._news:
            if not self._news.wait_for(lambda: self._ends or latest(), _SLOWEST_S):
                raise UserError(f"{self.name}: no picture for {_SLOWEST_S:g} s")
            picture = latest()
        if picture is None and self._error is not None:
            if isinstance(self._error, UserError):
                raise self._error
            raise UserError(f"{self.name}: reading failed ({first_line(self._error)})") from self._error
        return picture

    def _read(self) -> None:
        try:
            self._keep_latest()
        except Exception as error:  # raised where pictures are asked for
            self._error = error
        finally:
            with self._news:
                self._ends = True
                self._news.notify()

    def _keep_latest(self) -> None:
        number = failures = 0
        while not self._ends and failures < _FAILURES:
            good, bgr = self._capture.read()
            time_s = self._clock()
            failures = 0 if good else failures + 1
            if good:
                refuse_large(bgr.shape[1], bgr.shape[0])
                picture = Picture(number, time_s, cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))
                number += 1
                with self._news:
                    self._latest = picture
                    self._news.notify()
