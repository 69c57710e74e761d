"""Camera calibrations as programs write them: one pinhole camera, or a stereo pair.

OpenCV's FileStorage (YAML, XML, JSON), `camera_info` and `ost.txt` of ROS, Kalibr's camchain, EuRoC's
sensors in one file, MATLAB's parameters as JSON, NeRF's transforms.json, COLMAP's cameras.txt, Metashape's
XML, a bare matrix, and other YAML, JSON or INI with matrices, or with fx, fy, cx, cy and k1, k2, p1, p2, k3.
Where no distortion is stated it is 0.
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import cv2
import numpy as np

from synth.arrays import Floats
from synth.errors import UserError, as_user_error
from synth.system import checked_file

# Names in lower case, without punctuation and without the camera's number or side.
_MATRIX = "cameramatrix", "k", "m", "cm", "mtx", "intrinsicmatrix", "intrinsics", "cameraintrinsics"
_LENS = "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distortion", "d", "dist", "kc", "coeffs"
_SCALARS = ("fx", "fcx", "flx"), ("fy", "fcy", "fly"), ("cx", "ccx", "ppx"), ("cy", "ccy", "ppy")
_ANGLE, _RECTIFIED = "cameraanglex", ("p", "projectionmatrix")
_RADIAL, _TANGENTIAL = ("radial", "radialdistortion"), ("tangential", "tangentialdistortion")
_CORNER = "flx", "colmap"  # values whose principal point counts from the corner of the first pixel
_POSE = "tbs"  # 4 x 4, from a camera of EuRoC to the body
_TERMS = "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"
_TURN = "r", "rotation", "rotationmatrix"
_SHIFT = "t", "translation", "translationvector", "translationofcamera"
_TURN_ROWS = "rotationofcamera"  # of MATLAB, for row vectors
_KALIBR = "tcncnm1"  # 4 x 4, from the left camera to the right one
_WIDTH, _HEIGHT = ("imagewidth", "width", "resx", "w"), ("imageheight", "height", "resy", "h")
_SIZE = "resolution", "imagesize", "imgsize", "imgshape", "imageshape"
_MODEL = re.compile(r"((distortion|camera|lens|projection)(model|type)|model)(name)?")
_PINHOLE = "distortion|pinhole|opencv|plumbbob|rad(tan|ialtangential)|brown|conrady|rationalpolynomial|none"
_OTHER = re.compile("fisheye|omnidir|thinprism|^xi$")  # keys of other models
_OFF = "", "0", "0.0", "false", "none"  # values of these keys in a file of a pinhole camera
_INTRINSIC = {*_MATRIX, *_LENS, *chain.from_iterable(_SCALARS)}
_SIDED = re.compile("(left|right)?(.*?)(left|right|[012])?")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_LARGEST, _MOST_TANGENTIAL, _ORTHOGONAL = 1e6, 0.05, 1e-3
_ODD_TANGENTIAL, _ODD_RADIAL = 0.01, 0.1  # p1, p2, and k3 next to it, as if k3 came before p1 and p2
_COLMAP = {
    "SIMPLE_PINHOLE": "fx cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "fx cx cy k1",
    "RADIAL": "fx cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
LARGEST_FILE = 1 << 20  # bytes


def read_lens(path: Path, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """The only or the left camera, for pictures of a size (width, height) [px] with the same field of view.

    K (3, 3) px, with the centre of the top-left pixel at (0, 0), and distortion (4, 5, 8, 12 or 14,) k1, k2,
    p1, p2, k3, ... UserError: unreadable, another camera model, or made from pictures of another shape.
    """
    return _load(path)[0].lens(size)


def read_pair(
    path: Path, size: tuple[int, int]
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats], Floats, Floats, float | None]:
    """The left and the right camera, as `read_lens`, R (3, 3) and T (3,) of x_right = R x_left + T.

    Last the millimetres per unit of T if the format has a unit. UserError also for a missing or wrong R or T.
    """
    left, right, _ = _load(path)
    lenses = left.lens(size), right.lens(size, shifted=True)
    return *lenses, *_pose(left, right)


def find_baseline_mm(path: Path) -> float:
    """Distance of a pair's cameras, with T in mm if the format has no unit; 0: no pair, or unreadable."""
    with suppress(UserError):  # reported by those that read the cameras
        left, right, is_pair = _load(path)
        _, translation, unit = _pose(left, right)
        return is_pair * float(np.linalg.norm(translation)) * (unit or 1.0)  # R and T of one are its pose
    return 0.0


def describe(path: Path) -> list[str]:
    """What is assumed of a calibration that its file doesn't state, in words; nothing if it is unreadable."""
    notes = list[str]()
    with suppress(UserError):
        left, right, is_pair = _load(path)
        for camera in (left, right)[: 1 + is_pair]:
            if camera.numbers(_MATRIX, *_SCALARS).size:
                notes += (
                    []
                    if camera.states_distortion
                    else [f"{path.name} states no distortion: it is taken for 0"]
                )
            elif camera.numbers([_ANGLE]).size:
                notes.append(f"{path.name} states an angle of view only: centre and distortion are assumed")
            elif camera.numbers(_RECTIFIED).size:
                notes.append(f"{path.name} holds P1 and P2 alone: the pictures are taken for rectified ones")
    return list(dict.fromkeys(notes))


def _pose(left: _Values, right: _Values) -> tuple[Floats, Floats, float | None]:
    """R (3, 3), T (3,) and its unit of `read_pair`."""
    combined = _Values(left.path, {**left.entries, **right.entries})
    rotation, translation = combined.numbers(_TURN), combined.numbers(_SHIFT)
    in_metres = not rotation.size and _KALIBR in combined.entries
    if in_metres and (transform := combined.numbers([_KALIBR])).size == 16:
        rotation, translation = transform.reshape(4, 4)[:3, :3], transform.reshape(4, 4)[:3, 3]
    if not rotation.size and (row_rotation := combined.numbers([_TURN_ROWS])).size == 9:
        rotation = row_rotation.reshape(3, 3).T
    if not rotation.size and (poses := [camera.numbers([_POSE]) for camera in (left, right)])[1].size == 16:
        to_body = [pose.reshape(4, 4) if pose.size == 16 else np.eye(4) for pose in poses]
        if np.abs(np.linalg.det(to_body)).min() > 0:
            transform, in_metres = np.linalg.inv(to_body[1]) @ to_body[0], True
            rotation, translation = transform[:3, :3], transform[:3, 3]
    if not rotation.size and (projection := right.numbers(_RECTIFIED)).size == 12 and projection[0]:
        rotation, translation = np.eye(3), projection.reshape(3, 4)[:, 3] / projection[0]
    if rotation.size == 3:
        rotation = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    if rotation.size != 9 or translation.size != 3 or not 0 < np.abs(translation).max() < _LARGEST:
        raise combined.error("R or T of the right camera is missing, or has another shape")
    rotation = rotation.reshape(3, 3)
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() < _ORTHOGONAL or np.linalg.det(rotation) < 0:
        raise combined.error("R is not a rotation")
    return rotation, translation, 1000.0 if in_metres else None


class _Values(NamedTuple):
    """Values of one camera by name."""

    path: Path
    entries: dict[str, Any]

    def numbers(self, *names: Iterable[str]) -> Floats:
        """Those of the first name of each group that is there, flat."""
        keys = [next((key for key in group if key in self.entries), "") for group in names]
        try:
            return np.array(
                [x for name in keys for x in islice(_flat(self.entries.get(name)), 20)], np.float64
            )
        except (TypeError, ValueError, OverflowError, RecursionError):
            raise self.error(f"{' or '.join(keys)} is not a matrix of numbers") from None

    def error(self, fault: str) -> UserError:
        return UserError(f"{self.path}: {fault}")

    @property
    def states_distortion(self) -> bool:
        """Whether distortion is given in any form."""
        return any(name in self.entries for name in (*_LENS, *_RADIAL, "k1"))

    def lens(self, size: tuple[int, int], shifted: bool = False) -> tuple[Floats, Floats]:
        """K and distortion; `shifted`: the principal point may be outside the picture."""
        K, lens = self._matrix(size), self._distortion()
        if not K[:2, 2].any() and K[2, :2].any():
            raise self.error(
                "the camera matrix is transposed, as MATLAB's IntrinsicMatrix: transpose it, and R. MATLAB "
                f"counts pixels from 1: its principal point here is {K[2, 0] - 1:g}, {K[2, 1] - 1:g}"
            )
        if not np.isfinite(K).all() or np.abs(K[[1, 2, 2], [0, 0, 1]]).any() or K[2, 2] != 1:
            raise self.error("the camera matrix is not [fx, 0, cx], [0, fy, cy], [0, 0, 1]")
        if np.abs(lens[2:4]).max() > _MOST_TANGENTIAL:
            raise self.error(
                f"p1, p2 = {lens[2]:g}, {lens[3]:g} is too much: of a fisheye lens, or in another order? "
                "needed are k1 k2 p1 p2 k3 of a pinhole camera"
            )
        tangential = float(np.abs(lens[2:4]).max())
        if lens.size == 5 and tangential > _ODD_TANGENTIAL and 0 < abs(lens[4]) < _ODD_RADIAL * tangential:
            raise self.error(
                f"k1 k2 p1 p2 k3 = {', '.join(f'{x:g}' for x in lens)}: is k3 before p1 and p2? "
                "Name the terms, as "
                "k1: ..., k2: ..., p1: ..., p2: ..., k3: ..."
            )
        K, full_size = self._crop(K, size)
        scale = np.array(size) / full_size
        if abs(scale[0] / scale[1] - 1) > 0.01:
            size_text = " x ".join(f"{length:g}" for length in full_size)
            raise self.error(
                f"made from pictures of {size_text}, whose shape is not that of {size[0]} x {size[1]}"
            )
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # centres, not corners, are whole
        K = np.diag([*scale, 1.0]) @ (K + half) - half
        (fx, skew, x), (_, fy, y), _ = K
        if not (0.1 * size[0] < fx < 200 * size[0] and 1 / 3 < fx / fy < 3 and abs(skew) < 1e-6 * fx):
            shares = "; they may be shares of width and height: multiply them" if 0 < fx < 10 else ""
            raise self.error(
                f"focal lengths {fx:g}, {fy:g} px with skew {skew:g} don't fit {size} px{shares}"
            )
        if not (0.05 * size[0] < x + 0.5 < 0.95 * size[0] or shifted) or not 0 < y + 0.5 < size[1]:
            raise self.error(
                f"the principal point {x:g}, {y:g} doesn't fit pictures of {size[0]} x {size[1]}; if the "
                "calibration's were of another size, add image_width and image_height"
            )
        if not np.abs(K).max() < _LARGEST:
            raise self.error(f"the camera matrix holds {np.abs(K).max():g}")
        return K, lens

    def _matrix(self, size: tuple[int, int]) -> Floats:
        """K (3, 3) as stated, from the centre of the first pixel."""
        matrix = self.numbers(_MATRIX)
        matrix = matrix if matrix.size else self.numbers(*_SCALARS)
        if matrix.size == 3 and "fy" not in self.entries:  # one focal length
            matrix = matrix[[0, 0, 1, 2]]
        if not matrix.size and (angle := self.numbers([_ANGLE])).size == 1 and 0 < angle[0] < np.pi:
            focal = 0.5 * size[0] / np.tan(0.5 * angle[0])
            return np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
        if not matrix.size and (projection := self.numbers(_RECTIFIED)).size == 12:
            return projection.reshape(3, 4)[:, :3]
        if matrix.size == 4:
            matrix = np.array([matrix[0], 0, matrix[2], 0, matrix[1], matrix[3], 0, 0, 1])
        if matrix.size != 9:
            raise self.error(f"no camera matrix (camera_matrix, K or fx, fy, cx, cy): {matrix.size} numbers")
        K = matrix.reshape(3, 3).copy()
        # MATLAB counts from 1.
        if "radialdistortion" in self.entries and "tangentialdistortion" in self.entries:
            K = K.T.copy() if not K[:2, 2].any() else K
            K[:2, 2] -= 1
        if any(name in self.entries for name in _CORNER):
            K[:2, 2] -= 0.5
        return K

    def _distortion(self) -> Floats:
        """k1, k2, p1, p2, ...: as one list, by name, or radial and tangential apart; 0 if it isn't stated."""
        lens = self.numbers(_LENS)
        if not lens.size and "k1" in self.entries:
            lens = np.array([self.numbers([name])[0] if name in self.entries else 0.0 for name in _TERMS])
        radial, tangential = self.numbers(_RADIAL), self.numbers(_TANGENTIAL)
        if not lens.size and radial.size in (2, 3) and tangential.size in (0, 2):
            sides = tangential if tangential.size else np.zeros(2)
            lens = np.array([*radial[:2], *sides, *(radial[2:] if radial.size == 3 else [0.0])])
        if not lens.size and not any(name in self.entries for name in (*_LENS, *_RADIAL)):
            lens = np.zeros(5)
        if lens.size not in (4, 5, 8, 12, 14) or not (np.abs(lens) < _LARGEST).all():
            raise self.error(f"{lens.size} distortion coefficients, needed are k1 k2 p1 p2, perhaps k3 ...")
        return lens

    def _crop(self, K: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """K of the pictures that were calibrated, and their size (2,): a ROS region, binned, of the
        sensor."""
        full_size = self.numbers(_WIDTH, _HEIGHT) if self.numbers(_WIDTH).size else self.numbers(_SIZE)
        if full_size.size and not (full_size.size == 2 and (full_size >= 1).all()):
            size_text = " x ".join(f"{length:g}" for length in full_size)
            raise self.error(
                f"made from pictures of {size_text}, whose shape is not that of {size[0]} x {size[1]}"
            )
        full_size = full_size if full_size.size else np.array(size, np.float64)
        if (
            abs(size[0] * full_size[0] / (size[1] * full_size[1]) - 1) < 0.01
            and not self.numbers(_WIDTH).size
        ):
            full_size = full_size[::-1]  # rows first
        area = self.entries.get("roi") if isinstance(self.entries.get("roi"), dict) else {}
        values = _Values(
            self.path, {re.sub("[^a-z]", "", str(k).lower()): v for k, v in (area or {}).items()}
        )
        binning = np.array([*self.numbers(["binningx"]), *self.numbers(["binningy"])])
        binning = np.maximum(binning, 1) if binning.size == 2 else np.ones(2)
        corner, region_size = values.numbers(["xoffset"], ["yoffset"]), values.numbers(["width"], ["height"])
        corner = corner if corner.size == 2 else np.zeros(2)
        region_size = region_size if region_size.size == 2 and region_size.all() else full_size
        if (binning == 1).all() and not corner.any() and (region_size == full_size).all():
            return K, full_size
        picture_size = region_size // binning
        if (picture_size != size).any():
            raise self.error(
                f"of {picture_size[0]:g} x {picture_size[1]:g} px, a region (roi) or binning of its sensor "
                f"of {full_size[0]:g} x {full_size[1]:g}, but the pictures are {size[0]} x {size[1]}"
            )
        return crop_matrix(K, corner, binning), picture_size


def crop_matrix(K: Floats, corner: Floats, binning: Floats) -> Floats:
    """The camera matrix (3, 3) px of a region of the sensor from a corner (x, y) px, binned (x, y)."""
    K = K.copy()
    K[:2, 2] = (K[:2, 2] - corner + 0.5) / binning - 0.5
    K[[0, 1], [0, 1]] /= binning
    return K


def _load(path: Path) -> tuple[_Values, _Values, bool]:
    """Values of the left and right camera, each with those of none, and whether there is a right one."""
    return _parse(path, checked_file.read_text(path, LARGEST_FILE, "utf-8-sig").strip())


@lru_cache(maxsize=4)  # every sequence of a job reads its calibration several times
def _parse(path: Path, text: str) -> tuple[_Values, _Values, bool]:
    if re.search(r"^\[(LEFT|RIGHT)_CAM_\w+\]", text, re.MULTILINE):
        raise UserError(
            f"{path}: of a ZED camera, for several sizes: write the matrices of yours, as its SDK "
            "gives them, as "
            "K1, D1, K2, D2, R, T"
        )
    tree: Any = _of_text(path, text)
    with as_user_error(f"{path}: is no calibration in XML, JSON or INI"):
        if text.startswith("<"):
            tree = _of_metashape(path, _tree(ElementTree.fromstring(text)))
        elif text.startswith("{"):
            tree = json.loads(text)
        elif tree is None and path.suffix.lower() == ".ini":
            parser = configparser.ConfigParser(interpolation=None, strict=False)
            parser.read_string(text)
            tree = {name: dict(parser[name]) for name in parser.sections()}
    if tree is None:
        # Long matrices as text, which is read much faster; OpenCV's head and tags are not YAML.
        text = re.sub(r"\bdata:\s*\[([^][\"]*)\]", r'data: "\1"', text.removesuffix("\n---"))
        text = re.sub(r"\A%YAML.*\n(---.*\n)?|!!opencv-\S+", "", text)
        tree = checked_file.load_yaml(text, str(path))
    if not isinstance(tree, dict):
        raise UserError(f"{path}: holds no named values")
    entries = sorted(
        _collect(path, tree), key=lambda entry: entry[0] != ""
    )  # a camera's own values come last
    first = 0 if any(side == "0" for side, _, _ in entries) else 1
    sides = ("", "left", str(first)), ("", "right", str(first + 1))
    intrinsics: dict[tuple[str, str], Any] = {}
    for side, name, value in entries:
        if name in _INTRINSIC and intrinsics.setdefault((side, name), value) != value:
            raise UserError(f"{path}: {name} of one camera is given twice; leave those of the video's size")
    left, right = ({name: value for side, name, value in entries if side in labels} for labels in sides)
    is_pair = any(side in sides[1][1:] for side, _, _ in entries)
    return _Values(path, left), _Values(path, right), is_pair


def _of_text(path: Path, text: str) -> dict[str, Any] | None:
    """Values of ROS's ost.txt, COLMAP's cameras.txt, RealSense's printed form, or a bare matrix; None: of
    another."""
    if "camera matrix" in text and "[image]" in text:
        ost = re.sub(r"#.*", "", text)

        def block(name: str, count: int) -> str:
            match = re.search(rf"^\s*{name}\s*\n((?:\s*{_NUMBER.pattern}){{1,{count}}})", ost, re.MULTILINE)
            return match[1] if match else ""

        fields = (
            ("image_width", "width", 1),
            ("image_height", "height", 1),
            ("camera_matrix", "camera matrix", 9),
        )
        blocks = {name: block(key, count) for name, key, count in (*fields, ("distortion", "distortion", 14))}
        return {name: value for name, value in blocks.items() if value}
    line_match = re.fullmatch(
        r"\[\s*(\d+)x(\d+)\s+p\[(\S+) (\S+)\]\s+f\[(\S+) (\S+)\]\s+([A-Za-z ]+?)\s*\[([^\]]*)\]\s*\]", text
    )
    if line_match:
        width, height, x, y, fx, fy, model, terms = line_match.groups()
        intrinsics = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": x, "cy": y}
        return intrinsics | {"distortion_model": model, "coeffs": terms}
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if all(len(row) > 4 and row[0].isdigit() and row[1].isupper() for row in rows) and rows:
        if len(rows) > 1:
            raise UserError(f"{path}: holds {len(rows)} cameras: leave the one of the video")
        ((_, model, width, height, *values),) = rows
        names = _COLMAP.get(model, "").split()
        if len(names) != len(values):
            known = ", ".join(_COLMAP)
            raise UserError(f"{path}: camera model {model} with {len(values)} values; known are {known}")
        return {**dict(zip(names, values, strict=True)), "width": width, "height": height, "colmap": "yes"}
    numbers = text.replace(",", " ").split()
    if len(numbers) in (9, 12, 16) and all(_NUMBER.fullmatch(word) for word in numbers):
        square = (
            np.array([float(word) for word in numbers]).reshape(len(rows), -1)
            if len(rows) in (3, 4)
            else None
        )
        return None if square is None else {"camera_matrix": square[:3, :3].tolist()}
    return None


def _of_metashape(path: Path, tree: Any) -> Any:
    """Values of Metashape's XML, whose centre is relative and whose p1, p2 are exchanged; others as they
    are."""
    if not isinstance(tree, dict) or not {"projection", "f", "cx"} <= tree.keys():
        return tree
    if tree["projection"] != "frame":
        raise UserError(f"{path}: projection {tree['projection']}: calibrate with a pinhole model (frame)")
    values = {name: float(text) for name, text in tree.items() if _NUMBER.fullmatch(str(text))}
    if values.get("b1") or values.get("b2") or values.get("k4"):
        raise UserError(f"{path}: b1, b2 or k4 is not 0: calibrate without them")
    width, height = values["width"], values["height"]
    terms = {"k1": "k1", "k2": "k2", "p1": "p2", "p2": "p1", "k3": "k3"}
    return {
        **{name: values.get(source, 0.0) for name, source in terms.items()},
        "fx": values["f"],
        "fy": values["f"],
        "cx": 0.5 * width + values.get("cx", 0.0) - 0.5,
        "cy": 0.5 * height + values.get("cy", 0.0) - 0.5,
        "width": width,
        "height": height,
    }


def _tree(node: ElementTree.Element) -> Any:
    return {child.tag: _tree(child) for child in node} or node.text


def _collect(path: Path, tree: Any, side: str = "", depth: int = 4) -> Iterator[tuple[str, str, Any]]:
    """Side, name and value of each entry of nested maps. UserError for the name of another camera model."""
    rows: dict[str, list[Any]] = {}
    inner_first = sorted(tree.items(), key=lambda item: not isinstance(item[1], dict))
    for key, value in inner_first:  # and outer values last, which override them
        lower, scalar = str(key).lower(), not isinstance(value, (dict, list))
        word = re.sub("[^a-z0-9]", "", lower)
        if scalar and re.fullmatch(r"[a-z]+_\d", lower):  # R_0, R_1, ...
            rows.setdefault(lower[:-2], []).append(value)
            continue
        match = None if word == _KALIBR or (scalar and word in _TERMS) else _SIDED.fullmatch(word)
        name, entry_side = (match[2], match[1] or match[3] or "") if match else (word, "")
        if isinstance(value, str) and _MODEL.fullmatch(name):
            model = re.sub("[^a-z0-9]", "", value.lower())
            if "inverse" in model and not any(_terms(tree)):
                model = "none"  # of RealSense, whose pictures are free of distortion
            is_other = not re.fullmatch(f"({_PINHOLE})+", model)
        else:
            is_other = bool(_OTHER.search(word)) and str(value).lower() not in _OFF
        if is_other:
            raise UserError(f"{path}: {key} is {value}: calibrate with a pinhole model (radtan, plumb_bob)")
        if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            value = {str(k): item for k, item in enumerate(value)}
        if name == "roi":
            yield entry_side or side, name, value
        elif isinstance(value, dict) and "data" not in value and depth:
            yield from _collect(path, value, entry_side or side, depth - 1)
        elif not (entry_side and name in (*_TURN, *_SHIFT[:3])):  # R1 and R2 are of rectification
            yield entry_side or side, name, value
    for name, values in rows.items():
        yield side, name, values


def _terms(tree: Any) -> list[float]:
    """The distortion next to a model's name; not 0 if it can't be read."""
    for key, value in tree.items():
        if re.sub("[^a-z0-9]", "", str(key).lower()) in _LENS:
            with suppress(TypeError, ValueError):
                return list(_flat(value))
    return [1.0]


def _flat(value: Any) -> Iterator[float]:
    """The numbers of a matrix in any form."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, str):
        yield from map(float, _NUMBER.findall(value))
    elif isinstance(value, list):
        for item in value:
            yield from _flat(item)
    elif value is not None:
        yield float(value)
