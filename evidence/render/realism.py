"""How far a rendering is from a photograph, in figures; the photograph itself stays where it is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from evidence.measuring import measuring
from evidence.render import picture_statistics
from evidence.render.case import case
from synth.errors import UserError
from synth.job.schema import Family, Job

_SIDE, _STEP = 160, 40
OUTLINE = (
    "0.2,0.56 0.29,0.31 0.39,0.19 0.52,0.16 0.6,0.29 0.67,0.42 0.71,0.6 0.67,0.73 0.6,0.86 0.47,0.91"
    " 0.37,0.86 0.28,0.76"
)
"""Of the cortex in the photograph that the figures here are of."""


@measuring("cortex.jpg", said="Folder for figures and sheet.", file="realism.json")
def realism_figures(
    photo: Annotated[Path, typer.Argument(help="A photograph of an exposed cortex.")],
    outline: Annotated[
        str, typer.Option(help="Polygon of the cortex in it, as shares: x,y x,y x,y ...")
    ] = OUTLINE,
    width_mm: Annotated[float, typer.Option(help="What the photograph's width spans in the field.")] = 110.0,
    frames: Annotated[int, typer.Option(min=1, help="Rendered sequences, one frame of each.")] = 12,
    family: Annotated[str, typer.Option(help="Appearance family.")] = "healthy",
    seed: Annotated[int, typer.Option(help="Of the rendered job.")] = 11,
    out: Path | None = None,
    beside: Annotated[
        Path | None,
        typer.Option(help="Also write the frames and the photograph, at equal scale, as this picture."),
    ] = None,
) -> dict[str, Any]:
    """Colour, spectrum, gradients and highlights of rendered frames against crops of a photograph."""
    pictures, crops, pixel = _rendered(frames, family, seed)
    reference = _photographed(photo, outline, width_mm / pixel)
    pooled = picture_statistics.pool(reference)
    theirs, ours = picture_statistics.spread(reference, pooled), picture_statistics.spread(crops, pooled)
    rows = [
        {
            "statistic": name,
            "photograph": [round(v, 4) for v in theirs[name]],
            "rendered": [round(v, 4) for v in ours[name]],
            "median_within_spread": theirs[name][0] <= ours[name][1] <= theirs[name][2],
        }
        for name in theirs
    ]
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(out / "sheet.webp"), _sheet(pictures)[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 24])
    if beside is not None:
        cv2.imwrite(str(beside), _beside(pictures, scaled_photograph(photo, width_mm / pixel))[..., ::-1])
    return {
        "family": family,
        "seed": seed,
        "crops": {"photograph": len(reference), "rendered": len(crops), "side_px": _SIDE},
        "photograph_width_mm_assumed": width_mm,
        "mm_per_px": round(pixel, 4),
        "statistics": rows,
    }


def _rendered(
    frames: int, family: str, seed: int
) -> tuple[list[picture_statistics.Picture], list[picture_statistics.Picture], float]:
    """Frames with the instrument, crops of the same without it, and the median mm of a pixel."""
    families: tuple[Family, ...] = Job.model_validate(
        {"appearance": {"families": [family]}}
    ).appearance.families
    shared = {"seed": seed, "sequences": frames, "appearance": {"families": families}}
    pictures, crops, pixels = [], [], []
    for index in range(frames):
        with_tool = case(Job.model_validate(shared), index)
        shot = with_tool.studio.frame(with_tool.vertices, with_tool.tips, with_tool.shafts, seed + index)
        pictures.append(shot.rgb)
        bare = case(Job.model_validate({**shared, "render": {"tool": False}}), index)
        plain = bare.studio.frame(bare.vertices, bare.tips, bare.shafts, seed + index).rgb
        inside = cv2.erode(bare.studio.still.tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        crops += picture_statistics.tiles(plain, inside, _SIDE, _STEP)
        pixels.append(bare.studio.still.scale_mm_per_px)
    return pictures, crops, float(np.median(pixels))


def _photographed(photo: Path, outline: str, width_px: float) -> list[picture_statistics.Picture]:
    """Crops of the photograph inside the outline, at the rendered frames' scale."""
    image = scaled_photograph(photo, width_px)
    crops = picture_statistics.tiles(image, outlined(outline, image.shape[:2]), _SIDE, _STEP)
    if not crops:
        raise UserError(f"{photo}: no crop of {_SIDE} px fits inside the outline")
    return crops


def outlined(outline: str, shape: tuple[int, ...]) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Pixels (H, W) inside a polygon given as shares of the picture, "x,y x,y ..."."""
    corners = np.array([[float(v) for v in pair.split(",")] for pair in outline.split()])
    inside = np.zeros(shape, np.uint8)
    cv2.fillPoly(inside, [np.rint(corners * np.array(shape[::-1])).astype(np.int32)], 1)
    return inside > 0


def scaled_photograph(photo: Path, width_px: float) -> picture_statistics.Picture:
    """The photograph (H, W, 3) sRGB, `width_px` wide."""
    image = cv2.imread(str(photo), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{photo}: not a picture that can be read")
    scale = width_px / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[..., ::-1])


def _beside(
    pictures: list[picture_statistics.Picture], photo: picture_statistics.Picture
) -> picture_statistics.Picture:
    """Frames in a column of two beside the photograph, all at their own size."""
    pictures = pictures + [np.zeros_like(pictures[0])] * (len(pictures) % 2)
    left = np.vstack([np.hstack(pictures[k : k + 2]) for k in range(0, len(pictures), 2)])
    tall = max(len(left), len(photo))
    parts = [np.pad(part, ((0, tall - len(part)), (0, 0), (0, 0))) for part in (left, photo)]
    return np.hstack(parts)


def _sheet(pictures: list[picture_statistics.Picture]) -> picture_statistics.Picture:
    columns = int(np.ceil(np.sqrt(len(pictures) * 4 / 3)))
    small = [cv2.resize(p, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for p in pictures]
    small += [np.zeros_like(small[0])] * (-len(small) % columns)
    rows = [np.hstack(small[k : k + columns]) for k in range(0, len(small), columns)]
    return np.vstack(rows)
