"""One compiled kernel serves every scene: what differs between scenes is data, never code."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from synth.job import reader
from synth.render.camera import camera
from synth.render.mitsuba.adapter import pick
from synth.render.scene import Moment, Studio
from synth.sequence import pipeline, scenario
from synth.system import cache

SMALL = ["render.size=[64, 48]", "sequences=4", "anatomy.vertices=2500", "render.spp=4"]
_LARGE = 500  # operations: a kernel that traces light; the rest fill and copy arrays


@pytest.mark.slow
@pytest.mark.parametrize("scenery", ["[]", "[retractor, cottonoid, bone, drape]"])
def test_scenes_share_their_kernels(scenery: str) -> None:
    if pick("auto") == "scalar_rgb":
        pytest.skip("no LLVM here, so nothing is compiled")
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    job = reader.load_job("demo", [*SMALL, f"render.scenery={scenery}"])
    tips = np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]])
    shafts = np.tile([0.3, 0.2, 0.93], (2, 1))
    large = []
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        for index in range(job.sequences):
            case = scenario.draw(job, index)
            surface, _ = pipeline.cortex(job, case)
            kinds = [gesture.kind for gesture in case.gestures]
            studio = Studio(surface, case.look, camera.place(case.view, job.render), job, kinds)
            for frame in range(2):
                moment = Moment(surface.vertices + 0.1 * frame, tips, shafts)
                studio.shoot(moment, seed=frame)
            found = [one for one in dr.kernel_history() if one.get("operation_count", 0) > _LARGE]
            large.append({one["hash"] for one in found})
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert large[0]
    assert all(one == large[0] for one in large), large


def test_the_cache_falls_back_to_a_place_that_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder should be")
    monkeypatch.setenv("SULCUS_CACHE", str(blocked))
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    cache.folder.cache_clear()
    try:
        place = cache.folder("kernels")
        (place / "kernel").write_bytes(b"12345")
        assert place == tmp_path / f"sulcus-{os.getuid()}" / "kernels"
        assert cache.size_bytes(place) == 5
        assert place.parent.stat().st_mode & 0o077 == 0
    finally:
        cache.folder.cache_clear()
