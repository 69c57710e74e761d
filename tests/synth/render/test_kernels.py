"""One compiled kernel serves every scene: what differs between scenes is data, never code."""

from __future__ import annotations

import numpy as np
import pytest

from synth.job import reader
from synth.render.mitsuba.adapter import pick
from synth.render.scene import SceneState
from synth.sequence.scene import at_rest

SMALL = ["render.size=[64, 48]", "sequences=4", "anatomy.vertices=2500", "render.spp=4"]
_LARGE = 500  # operations: a kernel that traces light; the rest fill and copy arrays


@pytest.mark.slow
def test_scenes_share_their_kernels_with_scenery_and_without() -> None:
    if pick("auto") == "scalar_rgb":
        pytest.skip("no LLVM here, so nothing is compiled")
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    bare = reader.load_job("demo", SMALL)
    dressed = reader.load_job("demo", [*SMALL, "render.scenery=[retractor, cottonoid, bone, drape]"])
    tips = np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]])
    shafts = np.tile([0.3, 0.2, 0.93], (2, 1))
    large = []
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        for index, job in enumerate((bare, dressed)):
            scene = at_rest(job, index)
            for frame in range(2):
                state = SceneState(scene.surface.vertices + 0.1 * frame, tips, shafts)
                scene.renderer.render(state, seed=frame)
            found = [one for one in dr.kernel_history() if one.get("operation_count", 0) > _LARGE]
            large.append({one["hash"] for one in found})
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert large[0]
    assert all(one == large[0] for one in large), large
