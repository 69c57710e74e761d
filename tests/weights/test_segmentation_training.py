"""Training of the segmentation."""

import numpy as np
import torch

from synth.flow import onnx_network, segmentation
from weights import segmentation_training
from weights.networks import SegmentationNet, read_onnx


def test_a_batch_holds_what_the_segmentation_is_given_turned_with_its_classes() -> None:
    rng = np.random.default_rng(2)  # which mirrors
    frame, rest = rng.integers(0, 256, (2, 160, 224, 3), np.uint8)
    bright = np.float32(frame.sum(-1, keepdims=True) > 400).repeat(3, -1)
    example = segmentation_training.pack((frame, rest, bright, 1 - bright))[None]
    inputs, classes, weights = segmentation_training.batch(example, rng)
    assert np.allclose(np.sort(inputs.ravel()), np.sort(segmentation.prepare(frame, rest).ravel()), atol=1e-5)
    light = inputs[0, :3].sum(0)
    assert light[classes[0, 0] == 1].min() > light[weights[0, 0] == 1].max()


def test_shipped_weights_are_read_back_for_training() -> None:
    net = SegmentationNet()
    read_onnx(net, segmentation.WEIGHTS)
    planes = np.random.default_rng(0).standard_normal((segmentation.CHANNELS, 64, 96), np.float32)
    logits = net.eval()(torch.from_numpy(planes)[None])[0].detach().numpy()
    assert np.allclose(logits, onnx_network.run(segmentation.WEIGHTS, planes), atol=1e-3)
