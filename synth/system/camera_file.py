"""Camera calibrations as programs write them: one pinhole camera, or a stereo pair.

OpenCV's FileStorage (YAML, XML, JSON), `camera_info` of ROS, Kalibr's camchain, and other YAML, JSON or INI
with matrices, or with fx, fy, cx, cy and k1, k2, p1, p2, k3.
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
_SCALARS = ("fx", "fcx"), ("fy", "fcy"), ("cx", "ccx", "ppx"), ("cy", "ccy", "ppy")
_TERMS = "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"
_TURN, _SHIFT = ("r", "rotation", "rotationmatrix"), ("t", "translation", "translationvector")
_KALIBR = "tcncnm1"  # 4 x 4, from the left camera to the right one
_WIDTH, _HEIGHT = ("imagewidth", "width", "resx"), ("imageheight", "height", "resy")
_SIZE = "resolution", "imagesize", "imgsize"
_MODEL = re.compile(r"((distortion|camera|lens|projection)(model|type)|model)(name)?")
_PINHOLE = "distortion|pinhole|opencv|plumbbob|rad(tan|ialtangential)|brown|conrady|rationalpolynomial|none"
_OTHER = re.compile("fisheye|omnidir|thinprism|^xi$")  # keys of other models
_INTRINSIC = {*_MATRIX, *_LENS, *chain.from_iterable(_SCALARS)}
_SIDED = re.compile("(left|right)?(.*?)(left|right|[012])?")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_LARGEST, _MOST_TANGENTIAL, _ORTHOGONAL = 1e6, 0.05, 1e-3
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


def _pose(left: _Values, right: _Values) -> tuple[Floats, Floats, float | None]:
    """R (3, 3), T (3,) and its unit of `read_pair`."""
    both = _Values(left.path, {**left.of, **right.of})
    rotation, translation = both.numbers(_TURN), both.numbers(_SHIFT)
    in_metres = not rotation.size and _KALIBR in both.of
    if in_metres and (moved := both.numbers([_KALIBR])).size == 16:
        rotation, translation = moved.reshape(4, 4)[:3, :3], moved.reshape(4, 4)[:3, 3]
    if rotation.size == 3:
        rotation = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    if rotation.size != 9 or translation.size != 3 or not translation.any():
        raise both.error("R or T of the right camera is missing, or has another shape")
    rotation = rotation.reshape(3, 3)
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() < _ORTHOGONAL or np.linalg.det(rotation) < 0:
        raise both.error("R is not a rotation")
    return rotation, translation, 1000.0 if in_metres else None


class _Values(NamedTuple):
    """Values of one camera by name."""

    path: Path
    of: dict[str, Any]

    def numbers(self, *names: Iterable[str]) -> Floats:
        """Those of the first name of each group that is there, flat."""
        chosen = [next((one for one in group if one in self.of), "") for group in names]
        try:
            return np.array([x for name in chosen for x in islice(_flat(self.of.get(name)), 20)], np.float64)
        except (TypeError, ValueError, OverflowError, RecursionError):
            raise self.error(f"{' or '.join(chosen)} is not a matrix of numbers") from None

    def error(self, fault: str) -> UserError:
        return UserError(f"{self.path}: {fault}")

    def lens(self, size: tuple[int, int], shifted: bool = False) -> tuple[Floats, Floats]:
        """K and distortion; `shifted`: the principal point may be outside the picture."""
        matrix, lens = self.numbers(_MATRIX), self.numbers(_LENS)
        matrix = matrix if matrix.size else self.numbers(*_SCALARS)
        if matrix.size == 4:
            matrix = np.array([matrix[0], 0, matrix[2], 0, matrix[1], matrix[3], 0, 0, 1])
        if not lens.size and "k1" in self.of:
            lens = np.array([self.numbers([name])[0] if name in self.of else 0.0 for name in _TERMS])
        if matrix.size != 9:
            raise self.error(f"no camera matrix (camera_matrix, K or fx, fy, cx, cy): {matrix.size} numbers")
        if lens.size not in (4, 5, 8, 12, 14) or not (np.abs(lens) < _LARGEST).all():
            raise self.error(f"{lens.size} distortion coefficients, needed are k1 k2 p1 p2, perhaps k3 ...")
        K = matrix.reshape(3, 3)
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
        made = self.numbers(_WIDTH, _HEIGHT) if self.numbers(_WIDTH).size else self.numbers(_SIZE)
        known = made.size == 2 and (made >= 1).all()
        scale = np.array(size) / (made if known else size)
        if (made.size and not known) or abs(scale[0] / scale[1] - 1) > 0.01:
            of = " x ".join(f"{one:g}" for one in made)
            raise self.error(f"made from pictures of {of}, whose shape is not that of {size[0]} x {size[1]}")
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # centres, not corners, are whole
        K = np.diag([*scale, 1.0]) @ (K + half) - half
        (fx, skew, x), (_, fy, y), _ = K
        if not (0.1 * size[0] < fx < 200 * size[0] and 1 / 3 < fx / fy < 3 and abs(skew) < 1e-6 * fx):
            raise self.error(f"focal lengths {fx:g}, {fy:g} px with skew {skew:g} don't fit {size} px")
        if not (0.05 * size[0] < x + 0.5 < 0.95 * size[0] or shifted) or not 0 < y + 0.5 < size[1]:
            raise self.error(
                f"the principal point {x:g}, {y:g} doesn't fit pictures of {size[0]} x {size[1]}; if the "
                "calibration's were of another size, add image_width and image_height"
            )
        return K, lens


def _load(path: Path) -> tuple[_Values, _Values, bool]:
    """Values of the left and right camera, each with those of none, and whether there is a right one."""
    return _parsed(path, checked_file.read_text(path, LARGEST_FILE, "utf-8-sig").strip())


@lru_cache(maxsize=4)  # every sequence of a job reads its calibration several times
def _parsed(path: Path, text: str) -> tuple[_Values, _Values, bool]:
    found: Any = None
    with as_user_error(f"{path}: is no calibration in XML, JSON or INI"):
        if text.startswith("<"):
            found = _tree(ElementTree.fromstring(text))
        elif text.startswith("{"):
            found = json.loads(text)
        elif path.suffix.lower() == ".ini":
            parser = configparser.ConfigParser(interpolation=None, strict=False)
            parser.read_string(text)
            found = {name: dict(parser[name]) for name in parser.sections()}
    if found is None:
        # Long matrices as text, which is read much faster; OpenCV's head and tags are not YAML.
        text = re.sub(r"\bdata:\s*\[([^][\"]*)\]", r'data: "\1"', text.removesuffix("\n---"))
        text = re.sub(r"\A%YAML.*\n(---.*\n)?|!!opencv-\S+", "", text)
        found = checked_file.load_yaml(text, str(path))
    if not isinstance(found, dict):
        raise UserError(f"{path}: holds no named values")
    held = sorted(_collected(path, found), key=lambda one: one[0] != "")  # a camera's own values come last
    first = 0 if any(side == "0" for side, _, _ in held) else 1
    sides = ("", "left", str(first)), ("", "right", str(first + 1))
    given: dict[tuple[str, str], Any] = {}
    for side, name, value in held:
        if name in _INTRINSIC and given.setdefault((side, name), value) != value:
            raise UserError(f"{path}: {name} of one camera is given twice; leave those of the video's size")
    left, right = ({name: value for side, name, value in held if side in one} for one in sides)
    is_pair = any(side in sides[1][1:] for side, _, _ in held)
    return _Values(path, left), _Values(path, right), is_pair


def _tree(node: ElementTree.Element) -> Any:
    return {child.tag: _tree(child) for child in node} or node.text


def _collected(path: Path, found: Any, side: str = "", depth: int = 4) -> Iterator[tuple[str, str, Any]]:
    """Side, name and value of each entry of nested maps. UserError for the name of another camera model."""
    rows: dict[str, list[Any]] = {}
    inner_first = sorted(found.items(), key=lambda one: not isinstance(one[1], dict))
    for key, value in inner_first:  # and outer values last, which override them
        lower, scalar = str(key).lower(), not isinstance(value, (dict, list))
        word = re.sub("[^a-z0-9]", "", lower)
        if scalar and re.fullmatch(r"[a-z]+_\d", lower):  # R_0, R_1, ...
            rows.setdefault(lower[:-2], []).append(value)
            continue
        match = None if word == _KALIBR or (scalar and word in _TERMS) else _SIDED.fullmatch(word)
        name, own = (match[2], match[1] or match[3] or "") if match else (word, "")
        if isinstance(value, str) and _MODEL.fullmatch(name):
            other = not re.fullmatch(f"({_PINHOLE})+", re.sub("[^a-z0-9]", "", value.lower()))
        else:
            other = bool(_OTHER.search(word)) and str(value).lower() not in ("", "0", "0.0", "false", "none")
        if other:
            raise UserError(f"{path}: {key} is {value}: calibrate with a pinhole model (radtan, plumb_bob)")
        if isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
            value = {str(k): one for k, one in enumerate(value)}
        if isinstance(value, dict) and "data" not in value and depth:
            yield from _collected(path, value, own or side, depth - 1)
        elif not (own and name in (*_TURN, *_SHIFT)):  # R1 and R2 are of rectification
            yield own or side, name, value
    for name, values in rows.items():
        yield side, name, values


def _flat(value: Any) -> Iterator[float]:
    """The numbers of a matrix in any form."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, str):
        yield from map(float, _NUMBER.findall(value))
    elif isinstance(value, list):
        for one in value:
            yield from _flat(one)
    elif value is not None:
        yield float(value)
