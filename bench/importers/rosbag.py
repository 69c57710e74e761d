"""ROS 1 and ROS 2 bags (also a single .mcap or .db3), read by rosbags without a ROS installation."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal

import av
import cv2
import numpy as np
from scipy.spatial import KDTree

from bench.importers.importer_registry import LARGEST_BYTES, Intake, SecondView, choose_name
from synth.arrays import Array, Floats, Ints
from synth.errors import UserError
from synth.system import checked_file
from synth.system.camera_file import crop_matrix
from synth.system.checked_file import refuse_large

_PICTURES = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "foxglove_msgs/msg/CompressedVideo",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
)
_CODECS = {
    "h264": "h264",
    "x264": "h264",
    "libx264": "h264",
    "h265": "hevc",
    "hevc": "hevc",
    "libx265": "hevc",
}
_CODECS |= {"av1": "av1", "vp9": "vp9", "mpeg4": "mpeg4"}  # decoders by the words of encodings
_FORCES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Vector3Stamped")
_UNSTAMPED = ("geometry_msgs/msg/Wrench",)
_LENSES = ("sensor_msgs/msg/CameraInfo",)
_TERMS = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}  # of distortion, by its model
_BAYER = ("rggb", "bggr", "gbrg", "grbg")
_CHANNELS = {"mono": 1, "rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4, **{f"bayer_{order}": 1 for order in _BAYER}}
_ENCODINGS = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC1": "mono16", "16UC3": "bgr16"}
_YUV = {name: name.upper() for name in ("uyvy", "yuyv", "nv12", "nv21")}  # OpenCV's names
_YUV |= {"yuv422": "UYVY", "yuv422_yuy2": "YUYV"}
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_HEADER = 12  # bytes before the PNG in a compressed depth picture

_Read = Callable[[Path, Any], Array]
_Pictures = Callable[..., Iterator[Array]]


def read_source(source: Path, use: dict[str, str]) -> Intake:
    """Opens a bag: its only topic of pictures and of forces, or those named by `use`.

    Times are the messages' header stamps; if a topic's stamps are all zero, the bag's times. Raises UserError
    for no pictures, several topics of a kind, an unknown encoding, an unusable calibration.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    notes, parts = list[str](), [source]
    if source.is_dir():
        if (source / "metadata.yaml").is_file():
            _refuse_elsewhere(source)
        else:
            parts = _parts(source, notes)

    def open_bag() -> Any:
        return AnyReader(parts, default_typestore=get_typestore(Stores.ROS2_HUMBLE))

    def pictures(topic: str, reader: _Read = _picture) -> Iterator[Array]:
        with open_bag() as bag:
            if reader is _picture and _is_packets(bag, topic):
                yield from (picture for _, picture in _decode(bag, topic))
                return
            for _, message in _messages(bag, topic):
                yield reader(source, message)

    with open_bag() as bag:
        second_topic = use.get("right") or use.get("depth")
        frames = _topic(bag, "frames", _PICTURES, use, second_topic)
        if frames is None:
            raise UserError(f"{source}: holds no topic of pictures; there are {_kinds(bag)}")
        stamps = _stamps(bag, frames, notes)
        topic, read = _force_topic(bag, use, notes)
        force = _table(bag, topic, read, 3, notes)
        if topic is None:
            notes.append(f"no topic of forces; there are {_kinds(bag)}")
        intake = Intake(stamps, partial(pictures, frames), force[:, 0], force[:, 1:], tuple(notes))
        if second_topic is not None:
            return _add_second(bag, intake, frames, use, pictures)
        if unused := {"calibration", "right_calibration"} & use.keys():
            raise UserError(f"--use {min(unused)}=...: requires right=TOPIC or depth=TOPIC")
        return intake


def _add_second(bag: Any, intake: Intake, frames: str, use: dict[str, str], pictures: _Pictures) -> Intake:
    """Adds the right or depth camera; frames before its first picture and after its last are left out.

    Calibrations are the topics `calibration` and `right_calibration`, else the pictures' own `camera_info`.
    """
    kind: Literal["right", "depth"] = "right" if "right" in use else "depth"
    if {"right", "depth"} <= use.keys():
        raise UserError("--use right=... and depth=...: give one of them")
    topic = _topic(bag, kind, _PICTURES, use) or ""
    notes = list(intake.notes)
    frame = partners(_stamps(bag, topic, notes), intake.times_s)
    if (frame < 0).all():
        raise UserError(f"{topic}: no picture is at the time of a frame of {frames}")
    first, last = int(frame[frame >= 0].min()), int(frame.max())
    times = intake.times_s[first : last + 1]
    notes += [f"{topic}: pictures for {(frame >= 0).sum()} of {len(intake.times_s)} frames of {frames}"]
    if len(times) < len(intake.times_s):
        notes.append(f"frames before {first} and after {last} have none and are left out")
    left = _lens(bag, frames, use.get("calibration"), next(pictures(frames)))
    view = SecondView(kind, np.where(frame < 0, -1, frame - first), partial(pictures, topic))
    if kind == "right":
        right = _lens(bag, topic, use.get("right_calibration"), next(pictures(topic)))
        view = replace(view, pair=None if left is None or right is None else _join_pair(left, right))
    else:
        view = replace(view, pictures=partial(pictures, topic, _depth))
        if left is not None:
            notes.append(f"{topic} is assumed to be registered to {frames}, pixel by pixel")
            lens = {"focal_px": float(left.K[0, 0]), "centre_px": left.K[:2, 2].tolist()}
            view = replace(view, lens=lens)
            if left.distortion.any():
                notes.append(f"the distortion of {frames} is ignored for depth")
    if view.pair is None and view.lens is None:
        section = {"right": "stereo", "depth": "depth"}[kind]
        notes.append(f"no calibration found (camera_info): add {section} to meta.yaml")
    return replace(
        intake,
        times_s=times,
        pictures=lambda: islice(pictures(frames), first, last + 1),
        notes=tuple(notes),
        second=view,
    )


def partners(times_s: Floats, frames_s: Floats) -> Ints:
    """The frame (T,) of each picture (M,) of another camera: mutually nearest in time [s] and at most half a
    frame interval away; -1: none."""
    distance_s, frame = KDTree(frames_s[:, None]).query(times_s[:, None])
    picture = KDTree(times_s[:, None]).query(frames_s[:, None])[1]
    step = float(np.median(np.diff(np.sort(frames_s)))) if len(frames_s) > 1 else np.inf
    return np.where((picture[frame] == np.arange(len(times_s))) & (distance_s <= step / 2), frame, -1)


def _lens(bag: Any, pictures: str, requested: str | None, picture: Array) -> _Lens | None:
    names = sorted({c.topic for c in bag.connections if c.msgtype in _LENSES})
    usual_topic = _info_name(pictures)
    if not requested and usual_topic not in names:
        return None
    topic = choose_name("calibration", requested or usual_topic, names, "topic") or usual_topic
    _, info = next(_messages(bag, topic))
    return _read_lens(topic, info, pictures, (picture.shape[1], picture.shape[0]))


def _refuse_elsewhere(folder: Path) -> None:
    """Raises UserError for a metadata.yaml without files, or with files outside the bag's folder."""
    path = folder / "metadata.yaml"
    tree = checked_file.read_yaml(path)
    about = tree.get("rosbag2_bagfile_information") if isinstance(tree, dict) else None
    names = about.get("relative_file_paths") if isinstance(about, dict) else None
    if not isinstance(names, list):
        raise UserError(f"{path}: relative_file_paths is missing")
    for name in names:
        if not isinstance(name, str) or name != Path(name).name:
            label = name[:80] if isinstance(name, str) else "a file"  # other YAML may be endless
            raise UserError(f"{path}: {label} is not in the bag's folder")
        checked_file.check_file(folder / name, LARGEST_BYTES)


def _topic(
    bag: Any, role: str, kinds: tuple[str, ...], use: dict[str, str], excluded: str | None = None
) -> str | None:
    names = sorted({c.topic for c in bag.connections if c.msgtype in kinds} - {excluded})
    others = {c.topic: c.msgtype for c in bag.connections if c.topic not in names}
    return choose_name(role, use.get(role), names, "topic", others)


def _parts(folder: Path, notes: list[str]) -> list[Path]:
    """The files of a bag whose metadata.yaml is lost, of one kind. UserError: they are of two."""
    files = sorted(path for path in folder.glob("*") if path.suffix in (".mcap", ".db3"))
    for path in files:
        checked_file.check_file(path, LARGEST_BYTES)
    if len({path.suffix for path in files}) > 1:
        raise UserError(f"{folder}: holds .mcap and .db3 files and no metadata.yaml: name one of them")
    notes.append(f"no metadata.yaml: {', '.join(path.name for path in files)} are read as one bag")
    return files


def _kinds(bag: Any) -> str:
    """The topics of a bag with their types."""
    return ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections})) or "none"


def _force_topic(
    bag: Any, use: dict[str, str], notes: list[str]
) -> tuple[str | None, Callable[[Any], tuple[float, ...]]]:
    """The topic of forces, and how they are read from its messages; None: there is none.

    Stamped wrenches and vectors come first, then wrenches inside other messages. Arrays of three or six
    numbers
    count only if they are named. UserError: several topics, or one that holds no force.
    """
    wanted = use.get("force")
    stamped = wanted is None and any(c.msgtype in _FORCES for c in bag.connections)
    forces = _FORCES if stamped else (*_FORCES, *_UNSTAMPED)
    plain = {c.topic for c in bag.connections if c.msgtype in forces}
    if (plain and wanted is None) or wanted in plain:
        return _topic(bag, "force", forces, use), _vector
    paths: dict[str, tuple[str, ...]] = {}
    for connection in bag.connections:
        if connection.msgtype not in _PICTURES and (wanted in (None, connection.topic)):
            path = _find_vector(next((m for _, m in _messages(bag, connection.topic)), None))
            if path is not None and (path[-1:] != (_ARRAY,) or wanted is not None):
                paths[connection.topic] = path
    others = {c.topic: c.msgtype for c in bag.connections if c.topic not in paths}
    topic = choose_name("force", wanted, sorted(paths), "topic", others)
    if topic is None:
        return None, _vector
    path = paths[topic]
    if path[-1:] == (_ARRAY,):
        notes.append(f"{topic}: the first three numbers of {'.'.join(path[:-1])} are taken for fx, fy, fz")
        return topic, lambda message: tuple(float(x) for x in _follow_path(message, path[:-1])[:3])
    notes.append(f"{topic}: the force is its {'.'.join(path)}")
    return topic, lambda message: _vector(_follow_path(message, path))


_ARRAY = "[]"  # the end of a path to an array of numbers


def _find_vector(message: Any, depth: int = 4) -> tuple[str, ...] | None:
    """Names of the fields that lead to the only force in a message, or to an array of 3 or 6; None: there is
    none, or several."""
    forces, arrays = list[tuple[str, ...]](), list[tuple[str, ...]]()

    def search(part: Any, path: tuple[str, ...]) -> None:
        for name in getattr(part, "__dataclass_fields__", ()) if len(path) < depth else ():
            value = getattr(part, name)
            if name == "__msgtype__" or "covariance" in name:
                continue
            if name == "force" and all(hasattr(value, axis) for axis in "xyz"):
                forces.append((*path, name))
            elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.size in (3, 6):
                arrays.append((*path, name, _ARRAY))
            else:
                search(value, (*path, name))

    search(message, ())
    paths = forces or arrays
    return paths[0] if len(paths) == 1 else None


def _follow_path(message: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        message = getattr(message, name)
    return message


def _is_packets(bag: Any, topic: str) -> bool:
    """Whether a topic's messages are packets of a video, each of which needs those before it."""
    return _codec(next((m for _, m in _messages(bag, topic)), None)) != ""


def _codec(message: Any) -> str:
    """FFmpeg's name of the decoder of a message; empty: it is a picture of its own."""
    stated = str(getattr(message, "format", getattr(message, "encoding", ""))).lower()
    words = re.split("[^a-z0-9]+", stated)
    return next((codec for word in words for known, codec in _CODECS.items() if word.startswith(known)), "")


def _decode(bag: Any, topic: str) -> Iterator[tuple[int, Array]]:
    """Number of a topic's message and its picture (H, W, 3), of those that can be decoded."""
    context: Any = None
    numbered = enumerate(message for _, message in _messages(bag, topic))
    for k, message in chain(numbered, [(-1, None)]):
        if context is None:
            context = av.CodecContext.create(_codec(message), "r")
        packet = None
        if message is not None:
            packet = av.Packet(bytes(message.data))
            packet.pts = packet.dts = k
        try:
            frames = context.decode(packet)
        except av.error.InvalidDataError:  # before the first key frame, or damaged
            continue
        for frame in frames:
            if frame.pts is not None and not frame.is_corrupt:
                refuse_large(frame.width, frame.height)
                yield frame.pts, frame.to_ndarray(format="rgb24")


def _stamps(bag: Any, topic: str, notes: list[str]) -> Floats:
    """Times (T,) s of a topic's pictures."""
    stamps = _table(bag, topic, lambda message: (), 0, notes)[:, 0]
    if not _is_packets(bag, topic):
        return stamps
    indices = [k for k, _ in _decode(bag, topic)]
    if len(indices) < len(stamps):
        lost = len(stamps) - len(indices)
        notes.append(
            f"{topic}: {lost} of {len(stamps)} packets give no picture, as before the first key frame"
        )
    return stamps[indices]


def _messages(bag: Any, topic: str | None) -> Iterator[tuple[float, Any]]:
    """Time on the bag's clock [s] and message, in the bag's order; none without a topic."""
    connections = [c for c in bag.connections if c.topic == topic]
    if not connections:  # with an empty list rosbags would yield every message
        return
    for connection, logged, raw in bag.messages(connections):
        yield 1e-9 * logged, bag.deserialize(raw, connection.msgtype)


def _table(
    bag: Any, topic: str | None, read: Callable[[Any], tuple[float, ...]], width: int, notes: list[str]
) -> Floats:
    """Times [s] and values of a topic's messages, (N, 1 + width), all on one clock."""
    rows = []
    for logged, message in _messages(bag, topic):
        stamp = message.header.stamp if hasattr(message, "header") else getattr(message, "timestamp", None)
        rows.append((logged, stamp.sec + 1e-9 * stamp.nanosec if stamp else 0.0, *read(message)))
    table = np.array(rows, np.float64).reshape(-1, 2 + width)
    clock = 1 if (table[:, 1] > 0).any() else 0
    if rows and not clock:
        notes.append(f"{topic}: has no stamps: its times are those at which the bag received it")
    return np.column_stack([table[:, clock], table[:, 2:]])


def _vector(message: Any) -> tuple[float, float, float]:
    """The force in a message of one of `_FORCES` and `_UNSTAMPED`."""
    for part in ("wrench", "force", "vector"):
        message = getattr(message, part, message)
    return message.x, message.y, message.z


def _picture(source: Path, message: Any) -> Array:
    """RGB[A] or grey, of 8 or 16 bits."""
    if hasattr(message, "format"):
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR
        image = checked_file.decode_picture(bytes(message.data), flags)[..., ::-1]
        colour = message.format.split(";")[0].strip().rstrip("0168")
        is_mosaic = colour.startswith("bayer_") and (image == image[..., :1]).all()
        return _demosaic(np.ascontiguousarray(image[..., 0]), colour) if is_mosaic else image
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(-1, message.step)
    if (order := _YUV.get(message.encoding)) is not None:
        packed = rows[:, : message.width * (1 if order.startswith("NV") else 2)]
        packed = packed if order.startswith("NV") else packed.reshape(message.height, message.width, 2)
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(packed), getattr(cv2, f"COLOR_YUV2RGB_{order}")))
    encoding = _ENCODINGS.get(message.encoding, message.encoding)
    colour = encoding.rstrip("0168")
    channels, bits = _CHANNELS.get(colour), encoding[len(colour) :]
    if channels is None or bits not in ("8", "16"):
        known = ", ".join([*_CHANNELS, *_YUV])
        raise UserError(f"{source}: picture encoding {message.encoding}; supported: {known}, 8 or 16 bits")
    kind = np.dtype((">" if message.is_bigendian else "<") + f"u{int(bits) // 8}")
    values = np.ascontiguousarray(rows[:, : message.width * channels * kind.itemsize]).view(kind)
    picture = values.astype(kind.newbyteorder("=")).reshape(message.height, message.width, channels)
    if colour.startswith("bayer_"):
        return _demosaic(picture[..., 0], colour)
    return picture[..., [2, 1, 0]] if colour.startswith("bgr") else picture  # without opacity


def _demosaic(mosaic: Array, colour: str) -> Array:
    """RGB (H, W, 3) of a Bayer mosaic (H, W), by ROS's name of its order."""
    order = getattr(cv2, f"COLOR_Bayer{colour.removeprefix('bayer_').upper()}2RGB")
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(mosaic), order))


def _depth(source: Path, message: Any) -> Array:
    """Depth (H, W) mm, uint16 or float32; by ROS's REP 118 16-bit pictures are in mm, floats in metres."""
    if hasattr(message, "format"):
        if "compressedDepth" in message.format and message.format.startswith("32FC1"):
            raise UserError(f"{source}: inverse depth ({message.format}) is not supported; decompress it")
        data = bytes(message.data)[_HEADER * ("compressedDepth" in message.format) :]
        depth = checked_file.decode_picture(data, cv2.IMREAD_UNCHANGED)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise UserError(f"{source}: depth in {message.format} is not 16-bit")
        return depth
    if message.encoding not in _DEPTHS:
        raise UserError(f"{source}: depth encoding {message.encoding}; supported: {', '.join(_DEPTHS)}")
    kind = np.dtype((">" if message.is_bigendian else "<") + _DEPTHS[message.encoding])
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    depth = np.ascontiguousarray(rows[:, : message.width * kind.itemsize]).view(kind)
    return 1000 * depth.astype(np.float32) if kind.kind == "f" else depth.astype(np.uint16)


@dataclass(frozen=True)
class _Lens:
    """A camera and its pose in its stereo pair."""

    K: Floats  # (3, 3) px
    distortion: Floats  # (D,) in OpenCV's order
    turn: Floats  # (3, 3) rotation from its axes to the rectified pair's
    shift_mm: float  # x of the left lens in the rectified axes, with this lens at the origin


def _read_lens(topic: str, info: Any, pictures: str, size: tuple[int, int]) -> _Lens:
    """The camera of a calibration message of ROS 1 or 2, for a topic of pictures of width and height `size`;
    those named `image_rect...` are rectified. UserError for no calibration, or one for another size."""
    K, D, R, P = (np.asarray(getattr(info, n, getattr(info, n.upper(), ())), np.float64) for n in "kdrp")
    corner, binned, region_size = _region(info)
    if (region_size != size).any():
        size_text = f"{info.width} x {info.height}"
        if tuple(region_size) != (info.width, info.height):
            size_text += f", its region (roi) and binning give {region_size[0]} x {region_size[1]}"
        raise UserError(f"{topic}: calibrated at {size_text} px, but {pictures} has {size[0]} x {size[1]}")
    K, P = K.reshape(3, 3), P.reshape(3, 4)
    if not (np.isfinite([*K.flat, *P.flat]).all() and min(K[0, 0], K[1, 1], P[0, 0], P[1, 1]) > 0):
        raise UserError(f"{topic}: the camera isn't calibrated (K or P is 0)")
    shift_mm = 1000 * float(P[0, 3] / P[0, 0])
    K, rectified = (crop_matrix(matrix, corner, binned) for matrix in (K, P[:, :3]))
    if _image_name(pictures).startswith("image_rect"):
        return _Lens(rectified, np.zeros(5), np.eye(3), shift_mm)
    if D.any() and len(D) not in _TERMS.get(info.distortion_model, ()):
        model = f"{info.distortion_model} with {len(D)} terms"
        raise UserError(f"{topic}: distortion {model} is not one of OpenCV's models")
    return _Lens(K, D if D.any() else np.zeros(5), R.reshape(3, 3), shift_mm)


def _region(info: Any) -> tuple[Floats, Floats, Ints]:
    """Corner (x, y) px of the sensor's region in a calibration message, its binning, and its pictures' size.

    Width and height of the message are the whole sensor's; 0 stands for all of it, and for no binning.
    """
    binning = [max(int(getattr(info, name, 0)), 1) for name in ("binning_x", "binning_y")]
    roi, full_size = getattr(info, "roi", None), (int(info.width), int(info.height))
    corner, size = (0, 0), full_size
    if roi is not None and roi.width and roi.height:
        corner, size = (int(roi.x_offset), int(roi.y_offset)), (int(roi.width), int(roi.height))
    binned = np.array(binning, np.float64)
    return np.array(corner, np.float64), binned, np.array(size) // np.array(binning)


def _image_name(topic: str) -> str:
    """The last part of a picture topic's name, without its transport."""
    return [part for part in topic.split("/") if not part.startswith("compressed")][-1]


def _info_name(topic: str) -> str:
    """The topic on which ROS publishes the calibration of a picture topic."""
    return topic[: topic.rindex(_image_name(topic))] + "camera_info"


def _join_pair(left: _Lens, right: _Lens) -> dict[str, Floats]:
    """K1, D1, K2, D2, R, T [mm]: x_right = R x_left + T. UserError if the baseline is 0."""
    baseline = right.shift_mm - left.shift_mm
    if not baseline:
        raise UserError("the calibrations have no baseline (P[0, 3] of the right camera's camera_info)")
    rotation, translation = right.turn.T @ left.turn, right.turn.T @ [[baseline], [0.0], [0.0]]
    lenses = {"K1": left.K, "D1": left.distortion, "K2": right.K, "D2": right.distortion}
    return {**lenses, "R": rotation, "T": translation}
