"""A flow estimator of your own: Farneback's, with the protocol of the tracker and the bench.

    python examples/own_flow.py out

In an installed package this entry point makes it a job's `flow.backend` and the bench's `--flow`:

    [project.entry-points."sulcus.flow"]
    farneback = "own_flow:Farneback"
"""

from __future__ import annotations

import sys

import cv2
import numpy as np

import synth


class Farneback:
    """G. Farneback, "Two-frame motion estimation based on polynomial expansion", SCIA 2003."""

    def flow(
        self,
        rest: np.ndarray,
        now: np.ndarray,
        rest_usable: np.ndarray,
        now_usable: np.ndarray,
        initial: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow (H, W, 2) px at the pixels of `rest`, and its confidence (H, W) in 0..1."""
        first, second = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (rest, now))
        start = np.zeros((*first.shape, 2), np.float32) if initial is None else initial.copy()
        flags = 0 if initial is None else cv2.OPTFLOW_USE_INITIAL_FLOW
        flow = cv2.calcOpticalFlowFarneback(first, second, start, 0.5, 4, 15, 5, 7, 1.5, flags)
        y, x = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
        visible = cv2.remap(
            now_usable.astype(np.float32), x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR
        )
        return np.asarray(flow, np.float32), (rest_usable * (visible > 0.9)).astype(np.float32)


def error_px(sequence: synth.Sequence) -> float:
    """Mean endpoint error [px] over visible tissue of all frames but the first."""
    recovered = synth.recover_flow(
        sequence["rgb"][:], sequence["tool"][:], sequence["tissue"][:], Farneback()
    )
    error = np.linalg.norm(recovered.flow - sequence["flow"][:], axis=3)
    return float(error[1:][sequence["visible"][1:]].mean())


if __name__ == "__main__":
    for sequence in synth.Dataset(sys.argv[1]):
        print(sequence.index, f"{error_px(sequence):.3f} px")
