"""ROS 1 and ROS 2 bags (also a lone .mcap or .db3), read by rosbags without any ROS installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.importers.registry import Intake, one_of
from synth.errors import UserError
from synth.system import checked_file

_LARGEST_BYTES = 1 << 42
_PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_FORCES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Vector3Stamped")
_TIPS = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/TransformStamped",
)
_CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}


def read_source(source: Path, use: dict[str, str]) -> Intake:
    """Opens a bag: the only topic of pictures, of forces and of poses, or those named by `use`.

    Times are the messages' own stamps; a topic whose stamps are all zero falls back on the bag's. Positions,
    in metres by the ROS convention, become mm.

    Raises:
        UserError: no pictures, several topics of a kind, an unknown encoding.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if source.is_dir():
        _refuse_elsewhere(source)

    def opened() -> Any:
        return AnyReader([source], default_typestore=get_typestore(Stores.ROS2_HUMBLE))

    with opened() as bag:
        topics = {
            role: _topic(bag, role, kinds, use)
            for role, kinds in (("frames", _PICTURES), ("force", _FORCES), ("tip", _TIPS))
        }
        if topics["frames"] is None:
            raise UserError(f"{source}: holds no topic of pictures")
        stamps = _table(bag, topics["frames"], lambda message: (), 0)[:, 0]
        force = _table(bag, topics["force"], _vector, 3)
        tip = _table(bag, topics["tip"], _place, 3) * [1.0, 1000.0, 1000.0, 1000.0]

    def pictures() -> Iterator[NDArray[np.uint8]]:
        with opened() as bag:
            for _, message in _messages(bag, topics["frames"]):
                yield _picture(source, message)

    return Intake(stamps, pictures, force[:, 0], force[:, 1:], tip)


def _refuse_elsewhere(folder: Path) -> None:
    """UserError for a bag whose metadata.yaml is none, or names files that don't lie in its folder."""
    path = folder / "metadata.yaml"
    told = checked_file.read_yaml(path)
    about = told.get("rosbag2_bagfile_information") if isinstance(told, dict) else None
    names = about.get("relative_file_paths") if isinstance(about, dict) else None
    if not isinstance(names, list):
        raise UserError(f"{path}: doesn't say which files hold the bag")
    for name in map(str, names):
        if name != Path(name).name:
            raise UserError(f"{path}: names {name}, which is not in its folder")
        checked_file.check_file(folder / name, _LARGEST_BYTES)


def _topic(bag: Any, role: str, kinds: tuple[str, ...], use: dict[str, str]) -> str | None:
    names = sorted({c.topic for c in bag.connections if c.msgtype in kinds})
    return one_of(role, use.get(role), names, "topic")


def _messages(bag: Any, topic: str | None) -> Iterator[tuple[float, Any]]:
    """Time on the bag's own clock [s] and message, in the bag's order; nothing of no topic."""
    chosen = [c for c in bag.connections if c.topic == topic]
    if not chosen:  # of which rosbags would give every message
        return
    for connection, logged, raw in bag.messages(chosen):
        yield 1e-9 * logged, bag.deserialize(raw, connection.msgtype)


def _table(
    bag: Any, topic: str | None, read: Callable[[Any], tuple[float, ...]], width: int
) -> NDArray[np.float64]:
    """(N, 1 + width) times [s] and what is read of each message; one clock for all of them."""
    rows = [
        (logged, message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec, *read(message))
        for logged, message in _messages(bag, topic)
    ]
    table = np.array(rows, np.float64).reshape(-1, 2 + width)
    clock = 1 if (table[:, 1] > 0).any() else 0
    return np.column_stack([table[:, clock], table[:, 2:]])


def _vector(message: Any) -> tuple[float, float, float]:
    vector = message.wrench.force if hasattr(message, "wrench") else message.vector
    return vector.x, vector.y, vector.z


def _place(message: Any) -> tuple[float, float, float]:
    if hasattr(message, "pose"):
        place = message.pose.position
    elif hasattr(message, "point"):
        place = message.point
    else:
        place = message.transform.translation
    return place.x, place.y, place.z


def _picture(source: Path, message: Any) -> NDArray[np.uint8]:
    if hasattr(message, "format"):
        return checked_file.decode_picture(bytes(message.data)).astype(np.uint8)[..., ::-1]
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise UserError(f"{source}: pictures in encoding {message.encoding}; {', '.join(_CHANNELS)} are read")
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    picture = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if message.encoding.startswith(("bgr", "8UC3")):
        picture = picture[..., [2, 1, 0]]  # opacity is of no use
    return picture
