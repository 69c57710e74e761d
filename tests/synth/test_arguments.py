"""Arguments of the public functions: whatever is given, one line names the argument."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typing_extensions import TypeAliasType

import bench
import learn
import synth
from synth import arguments
from synth.errors import UserError

ODD: tuple[Any, ...] = (-1, float("nan"), True, [1, "a", None], {"a": 1}, object(), np.zeros(8), int, b"x")
CALLS: dict[Any, tuple[Any, ...]] = {
    synth.simulate: ({"job": "tiny"}, "index", "case", "motions", "mechanics"),
    synth.load_job: ({"source": "tiny"}, "source", "overrides"),
    synth.render_job: ({"job": "tiny", "out": "out"}, "job", "out", "workers", "memory_gb"),
    synth.write_scene: ({"scene": None, "folder": "out"}, "scene"),
    synth.open_sequence: ({}, "path"),
    synth.TorchDataset: ({"root": ".", "fields": ["rgb"]}, "root", "fields"),
    learn.load_model: ({"name": "stereo"}, "name", "threads"),
    learn.predict: ({"source": "video.mp4", "model": "stereo"}, "model", "membrane", "flow"),
    bench.estimate: ({"source": "video.mp4"}, "membrane", "flow"),
    bench.score: ({"recording": "here"}, "recording", "model", "settings", "out"),
}


@pytest.mark.parametrize("function", CALLS, ids=lambda called: called.__name__)
def test_an_odd_argument_is_named(function: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    defaults, *names = CALLS[function]
    for name in names:
        for value in ODD:
            with pytest.raises(UserError) as error:
                function(**{**defaults, name: value})
            assert re.search(rf"\b{name}\b|sequence -1|no such", str(error.value)), (name, value)
    assert not any(tmp_path.iterdir())


def test_a_named_alias_of_arrays_means_arrays() -> None:
    """As `NDArray` is since NumPy 2.5."""
    alias = TypeAliasType("alias", np.ndarray)
    assert arguments._fits(np.zeros(2), alias)
    assert not arguments._fits("a", alias)


def test_a_motion_is_at_rest_in_frame_0_and_finite() -> None:
    job = synth.load_job("tiny", ["frames=3", "fem.tets=300", "anatomy.vertices=1500", "render.size=[96,72]"])
    load, shift = np.array([0, 1.0, 0]), np.zeros((3, 2))
    for motion, name in (
        (synth.ToolMotion(load + 0.5, 1 - load, shift), "load"),
        (synth.ToolMotion(load * np.nan, 1 - load, shift), "load"),
        (synth.ToolMotion(load, 1 - load, shift + 1), "shift"),
        (synth.ToolMotion(load, load[:2], shift), "away"),
    ):
        with pytest.raises(UserError, match=rf"motions\[0\]: {name}"):
            synth.simulate(job, motions=[motion])


def test_an_error_in_a_dataset_is_the_one_that_is_raised(tmp_path: Path) -> None:
    dataset = synth.open_dataset(tmp_path / "out", "tiny")
    with pytest.raises(PermissionError, match="mine"), dataset as folder:
        raise PermissionError(13, "mine", (folder / "000000.zarr").mkdir())  # a folder that is no sequence
