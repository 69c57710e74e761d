"""Errors transferred between frames, against a known shortfall."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from learn.data.clips import Clip
from learn.data.grid import certainty
from learn.network.channels import rotate
from learn.settings import preset
from learn.training.batches import FrameDataset
from learn.training.error_transfer import Transfer, restate, transfer

WHOLE = Transfer(0, 0, (1.0, 1.0, 1.0))


def press(x: int, y: int, size: float) -> torch.Tensor:
    """(1, 3, 64, 64): a press and drag at a cell."""
    rows, columns = torch.meshgrid(torch.arange(64) - y, torch.arange(64) - x, indexing="ij")
    bump = size * torch.exp(-(rows**2 + columns**2) / 50)
    return torch.stack([(0.3 + 0.1 * columns) * bump, (0.1 + 0.1 * rows) * bump, bump])[None]


@pytest.mark.parametrize(("turn", "size"), [*product(range(8), (0.5, -1.0))])
def test_a_shortfall_stays_one_on_another_contact(turn: int, size: float) -> None:
    """Of a contact that is turned, elsewhere, smaller or a pull; its confidence goes with it."""
    true, donor = press(20, 30, 1.0), rotate(press(29, 37, size), turn)
    confidence = torch.rand(1, 2, 64, 64, generator=torch.Generator().manual_seed(0))
    planes = rotate(confidence.transpose(0, 1), turn).transpose(0, 1)
    motion, transferred = transfer(true, donor, -0.3 * donor, planes, WHOLE)
    torch.testing.assert_close(motion[..., :55, :55], 0.7 * true[..., :55, :55], atol=1e-3, rtol=0)
    torch.testing.assert_close(transferred[..., :50, :50], confidence[..., 7:57, 9:59])
    doubled = transfer(true, donor, -0.3 * donor, planes, WHOLE._replace(factor=(0, 0, 2)))
    torch.testing.assert_close(doubled[0][:, :2], true[:, :2])
    assert float(doubled[0][0, 2, 30, 20]) == pytest.approx(0.4, abs=0.01)
    once, thrice = (certainty(np.full((64, 64, 3), deviation)) for deviation in (0.05, 0.15))
    torch.testing.assert_close(restate(torch.from_numpy(once), 3.0), torch.from_numpy(thrice))


def test_labels_have_no_recovered_motion_but_errors_of_others(clips: list[Clip]) -> None:
    labels = [replace(clip, displacement={"ideal": clip.displacement["ideal"]}) for clip in clips]
    frames = FrameDataset([*clips, *labels], preset("tiny", size=32, input="mixed"))
    items = [item for k in range(5) for item in frames.order(np.random.default_rng(k))]
    label_items = [item for item in items if item.clip >= len(clips)]
    assert {item.source for item in label_items} == {"ideal"}
    assert 0.15 < np.mean([item.errors is None for item in label_items]) < 0.35
    assert all(item.errors is None or item.errors.clip < len(clips) for item in items)
    recovered = [item for item in items if item.source == "recovered" and item.deviation_factor == 1]
    assert 0.15 < len(recovered) / (len(items) - len(label_items)) < 0.35
