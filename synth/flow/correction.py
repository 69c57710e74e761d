"""What a flow misses, and how far off it may be: a small network that rendered scenes have taught.

The data term of a flow errs the same way wherever an instrument hides or shades tissue, and where a dimple
turns away from the lamps; no estimator's own terms say so, but rendered truth does. The network (a U-Net,
Ronneberger et al., MICCAI 2015) sees no pictures. It sees, on cells of 4 x 4 px, what is masked, the flow and
its agreement, how light and colour changed, and the steps that Lucas and Kanade's equations (IJCAI 1981)
would still take over two windows, in brightness and in colour, each freed of the window's mean change. All of
it is in pixels or ratios, so that little of a renderer's look can be learnt. It answers with what is to be
added and the logarithm of its variance (Kendall and Gal, NeurIPS 2017, eq. 5; Student's distribution).

`evidence.flow.correction_training` makes the weights; they lie beside this file with a card.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from synth.errors import UserError
from synth.flow import fused
from synth.flow.estimator import Flags, Flow, Map, Rgb
from synth.flow.image import GREY
from synth.system.jit import vectorised

WEIGHTS = Path(__file__).with_name("correction.pt")
CELL = 4
"""Pixels a side that are one cell."""
CHANNELS = 24
VECTORS = ((4, 5), (7, 8), (10, 11), (13, 14), (22, 23))
"""Channels that are x and y of a vector: a picture that is mirrored or turned changes them."""
_MULTIPLE = 8  # cells a side that the network's levels need
_WINDOWS = 3, 7  # cells a side
_WIDTHS = 20, 32, 48
_LEAST = 0.02  # squared gradients a pixel: windows of less contrast say nothing
_FARTHEST_PX = 2.0  # no step of a linear equation is believed beyond
_OFFSET = 8.0  # grey levels added before ratios: sensors' black is none


class CorrectionNet(nn.Module):
    """Features in, x, y [px] to be added and their log-variances out: (B, 24, h, w) → (B, 4, h, w)."""

    mean: Tensor
    deviation: Tensor

    def __init__(self) -> None:
        super().__init__()
        a, b, c = _WIDTHS
        self.register_buffer("mean", torch.zeros(1, CHANNELS, 1, 1))
        self.register_buffer("deviation", torch.ones(1, CHANNELS, 1, 1))
        self.stem = nn.Sequential(nn.Conv2d(CHANNELS, a, 1), nn.ReLU(), nn.Conv2d(a, a, 3, 1, 1), nn.ReLU())
        self.down = nn.ModuleList([_block(a, b, 2), _block(b, c, 2), _block(c, c, 2)])
        self.up = nn.ModuleList([_block(c + c, c), _block(c + b, b), _block(b + a, a)])
        self.head = nn.Conv2d(a, 4, 1)
        self.straight = nn.Conv2d(CHANNELS, 2, 1, bias=False)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.straight.weight)

    def forward(self, features: Tensor) -> Tensor:
        skips = [self.stem((features - self.mean) / self.deviation)]
        for layer in self.down:
            skips.append(layer(skips[-1]))
        field = skips.pop()
        for layer in self.up:
            wide = F.interpolate(field, scale_factor=2, mode="bilinear", align_corners=False)
            field = layer(torch.cat([wide, skips.pop()], 1))
        found = self.head(field)
        return torch.cat([found[:, :2] + self.straight(features), found[:, 2:]], 1)


@cache
def load(path: Path = WEIGHTS) -> CorrectionNet:
    """The network with its weights. Raises UserError if they aren't there."""
    if not path.is_file():
        raise UserError(f"{path.name}: the flow's correction is missing from this installation")
    net = CorrectionNet()
    state = torch.load(path, map_location="cpu", weights_only=True)
    net.load_state_dict({name: value.float() for name, value in state.items()})
    # As the processor's convolutions like it: two thirds of the time.
    return net.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def correct(net: CorrectionNet, features: NDArray[np.float32], flow: Flow) -> tuple[Flow, Map]:
    """A flow (H, W, 2) px with what is missing added, and its standard deviation, (H, W) px a component.

    Args:
        net: the network.
        features: (24, h, w), see `describe`.
        flow: (H, W, 2) px, the one described.
    """
    height, width = flow.shape[:2]
    with torch.inference_mode():
        cells = torch.from_numpy(padded(features))[None]
        found = net(cells.to(memory_format=torch.channels_last))
        wide = F.interpolate(found, scale_factor=CELL, mode="bilinear", align_corners=False)
        planes = wide[0, :, :height, :width].numpy()
    # The geometric mean of both components', within what was trained.
    spread = np.exp(0.25 * (planes[2].clip(-8, 5) + planes[3].clip(-8, 5)))
    return flow + planes[:2].transpose(1, 2, 0), spread


def padded(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """(..., h, w) with zeros to the right and below, as many cells as the network's levels need."""
    spare = [(0, 0)] * (cells.ndim - 2) + [(0, -n % _MULTIPLE) for n in cells.shape[-2:]]
    return np.pad(cells, spare)


def describe(
    rest: Rgb,
    now: Rgb,
    rest_usable: Flags,
    now_usable: Flags,
    greys: tuple[Map, Map],
    flow: Flow,
    agreed: Map,
) -> NDArray[np.float32]:
    """What the network sees of a frame and its flow: (24, h, w) float32 on cells of 4 x 4 px.

    Args:
        rest: (H, W, 3) uint8.
        now: (H, W, 3) uint8.
        rest_usable: (H, W), tissue that nothing hides in the rest frame.
        now_usable: (H, W), what nothing hides in the frame.
        greys: (H, W) both contrast-normalised.
        flow: (H, W, 2) px.
        agreed: (H, W) how well both agree along it, in 0..1.
    """
    height, width = agreed.shape
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    there = cv2.remap(now, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    warped, seen = np.empty((2, height, width), np.float32)
    planes = np.ascontiguousarray(flow.transpose(2, 0, 1))
    fused.warp_into(np.ascontiguousarray(greys[1]), now_usable.astype(np.float32), planes, warped, seen)
    mask = seen * rest_usable
    sums = np.zeros((2, 10, -(-height // CELL), -(-width // CELL)), np.float32)
    sum_products(greys[0], warped, mask, CELL, sums[0])
    sum_products(_colour(rest), _colour(there), mask, CELL, sums[1])
    m, seen, usable, agreed, u, v = means(mask, seen, rest_usable, agreed, flow[..., 0], flow[..., 1])
    area = np.maximum(m, 0.05)
    lights = [means(*(picture * mask[..., None]).transpose(2, 0, 1)) / area for picture in (rest, there)]
    change = (m > 0) * np.log((lights[1] + _OFFSET) / (lights[0] + _OFFSET))
    common = np.median(change[:, m > 0.5], axis=1) if (m > 0.5).any() else np.zeros(3)
    change = 3 * np.clip(change - common[:, None, None] * (m > 0), -1, 1)
    light = [0.5 * np.log1p(means(picture @ GREY)[0]) - 2 for picture in (rest, there)]
    steps = [_step(kind, side) for kind in sums for side in _WINDOWS]
    left = np.minimum(sums[0, 9] / (CELL * CELL * area), 4)
    rows = [m, seen, usable, left, *np.concatenate(steps), *change, *light, agreed, 0.25 * u, 0.25 * v]
    return np.stack(rows).astype(np.float32)


def _colour(rgb: NDArray[np.uint8]) -> Map:
    """(H, W) green against red, which shading leaves alone; about as large as a contrast-normalised grey."""
    red, green = rgb[..., 0].astype(np.float32), rgb[..., 1].astype(np.float32)
    return np.asarray(12 * (green - red) / (green + red + 2 * np.float32(_OFFSET)), np.float32)


def means(*planes: NDArray[Any]) -> NDArray[np.float32]:
    """(C, h, w) means over cells of planes (H, W); over fewer pixels at the border."""
    height, width = planes[0].shape
    spare, size = (0, -height % CELL, 0, -width % CELL), (-(-width // CELL), -(-height // CELL))
    small = []
    for plane in planes:
        wide = cv2.copyMakeBorder(np.asarray(plane, np.float32), *spare, cv2.BORDER_REPLICATE)
        small.append(cv2.resize(wide, size, interpolation=cv2.INTER_AREA))
    return np.stack(small)


def _step(sums: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Lucas and Kanade's step x, y [px] over windows of `side` cells, and how well it is known; (3, h, w)."""
    n, gx, gy, r, xx, xy, yy, xr, yr, _ = (
        cv2.boxFilter(one, -1, (side, side), borderType=cv2.BORDER_CONSTANT) for one in sums
    )
    n = np.maximum(n, 1)
    xx, xy, yy = xx / n - (gx / n) ** 2 + _LEAST, xy / n - gx * gy / n**2, yy / n - (gy / n) ** 2 + _LEAST
    xr, yr = xr / n - gx * r / n**2, yr / n - gy * r / n**2
    scale = 1 / (xx * yy - xy * xy)
    step = np.stack([xy * yr - yy * xr, xy * xr - xx * yr]) * scale
    least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    known = 0.5 * np.clip(np.log(np.maximum(least, _LEAST) / _LEAST), 0, 5)
    return np.stack([*(_FARTHEST_PX * np.tanh(step / _FARTHEST_PX)), known])


@vectorised
def sum_products(rest: Map, now: Map, mask: Map, cell: int, sums: NDArray[np.float32]) -> None:
    """Sums over cells of 1, g_x, g_y, r, g_x², g_x g_y, g_y², g_x r, g_y r, r² where `mask` is: (10, h, w).

    g is the gradient of the mean of both aligned pictures (H, W), r their difference, now - rest.
    """
    height, width = rest.shape
    half = np.float32(0.25)
    part = np.empty(10, np.float32)
    for row in range(sums.shape[1]):
        for column in range(sums.shape[2]):
            part[:] = 0
            for y in range(row * cell, min(row * cell + cell, height)):
                above, below = max(y - 1, 0), min(y + 1, height - 1)
                for x in range(column * cell, min(column * cell + cell, width)):
                    if mask[y, x] <= 0:
                        continue
                    left, right = max(x - 1, 0), min(x + 1, width - 1)
                    gx = half * (rest[y, right] - rest[y, left] + now[y, right] - now[y, left])
                    gy = half * (rest[below, x] - rest[above, x] + now[below, x] - now[above, x])
                    r = now[y, x] - rest[y, x]
                    part[0] += np.float32(1)
                    part[1] += gx
                    part[2] += gy
                    part[3] += r
                    part[4] += gx * gx
                    part[5] += gx * gy
                    part[6] += gy * gy
                    part[7] += gx * r
                    part[8] += gy * r
                    part[9] += r * r
            sums[:, row, column] = part


def _block(inside: int, outside: int, stride: int = 1) -> nn.Sequential:
    # A kernel of 4 halves about the cells' corners, as upsampling doubles; one of 3 would shift the field.
    return nn.Sequential(
        nn.Conv2d(inside, outside, 2 + stride, stride, 1),
        nn.ReLU(inplace=True),
        nn.Conv2d(outside, outside, 3, 1, 1),
        nn.ReLU(inplace=True),
    )
