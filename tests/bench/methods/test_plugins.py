"""Methods of other packages in scores and score.json; their errors become one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_package
from fake_model import write_model
from fake_recording import Maker

import bench
from bench.methods import comparison, method_plugins
from synth.errors import UserError

CODE = '''
import numpy as np
import bench


class Push:
    """The inverse of the recording's force law, with an error of 10%."""

    def __call__(self, frame, scene, picture):
        height, width = frame.flow.shape[:2]
        middle = frame.flow[height // 2 - 4 : height // 2 + 4, width // 2 - 4 : width // 2 + 4, 0]
        return bench.ForceEstimate(np.array([44.0 * float(np.median(middle)), 0.0, 0.0]))


raises = lambda: lambda *inputs: {}["nothing"]
exits = lambda: lambda *inputs: exit(0)
silent = lambda: lambda *inputs: None
short = lambda: lambda *inputs: bench.ForceEstimate(np.zeros(2))
nothing = lambda: None
'''
QUICK = bench.Settings(backend="dis", rate_hz=None, pulse=False)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Maker(tmp_path_factory.mktemp("plugins"))(frames=8)


def install_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **methods: str) -> None:
    values = {name: f"lab_methods:{attribute}" for name, attribute in methods.items()}
    points = {method_plugins.METHODS.group: values}
    tiny_package.install(tmp_path / "site", "lab_methods", CODE, points, monkeypatch)


@pytest.mark.slow
def test_a_plug_in_is_scored_with_the_network(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_methods(tmp_path, monkeypatch, pushes="Push")
    model = write_model(tmp_path / "model", "arch.output=vector")
    settings = bench.Settings(rate_hz=None, pulse=False)
    result = bench.score(recording, model, settings=settings, out=tmp_path / "score")
    assert next(iter(result.methods)) == result.main == "D2FNet"
    assert {"physics", "network and physics"} < set(result.methods)
    plugin_method = result.methods["pushes"]
    assert plugin_method.scores["mae_mn"] < np.nanmean(np.abs(result.sensor_mn)) / 3
    assert plugin_method.worse_by_mn is not None, "paired with the network on the same frames"
    tree = json.loads((tmp_path / "score/score.json").read_text("utf-8"))
    assert tree["methods"]["pushes"]["scores"]["mae_mn"] == pytest.approx(plugin_method.scores["mae_mn"])
    assert tree["settings"]["plug_ins"] == {"pushes": "lab_methods 1.2"}
    repeated = bench.score(recording, model, settings=settings)
    assert repeated.methods["pushes"].scores == pytest.approx(plugin_method.scores, nan_ok=True)
    assert "pushes" not in bench.score(recording, model, settings=settings, baselines=False).methods


@pytest.mark.parametrize("attribute", ["raises", "exits", "silent", "short", "nothing", "Missing"])
def test_errors_name_the_plug_in(
    attribute: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_methods(tmp_path, monkeypatch, own=attribute)
    model = write_model(tmp_path / "model", "arch.output=vector")
    with pytest.raises(UserError, match=rf"method own \(lab_methods:{attribute}\)"):
        bench.score(recording, model, settings=QUICK)


def test_a_method_cannot_change_the_others_input(recording: Path) -> None:
    def wipe(frame: Any, scene: Any, picture: bool) -> bench.ForceEstimate:
        force = bench.ForceEstimate(np.array([np.abs(frame.flow).max(), 0.0, 0.0]))
        frame.flow[:] = frame.confidence[:] = 0
        assert not scene.tissue.flags.writeable
        return force

    scored_methods = bench.score(
        recording, methods={"a": wipe, "b": wipe}, settings=QUICK, baselines=False
    ).methods
    np.testing.assert_array_equal(scored_methods["a"].size_mn, scored_methods["b"].size_mn)
    assert np.nanmax(scored_methods["b"].size_mn) > 0


def test_a_method_may_revise_a_whole_video(recording: Path) -> None:
    class Later:
        short = False

        def __call__(self, frame: Any, scene: Any, picture: bool) -> bench.ForceEstimate:
            return bench.ForceEstimate(np.zeros(3))

        def revise(self, contact_free: Any) -> list[bench.ForceEstimate]:
            count = len(contact_free) - self.short
            return [bench.ForceEstimate(np.array([1.0 + k, 0.0, 0.0])) for k in range(count)]

    later = Later()
    result = bench.score(recording, methods={"later": later}, settings=QUICK, baselines=False)
    assert result.methods["later"].size_mn.tolist() == [1.0 + k for k in range(len(result.time_s))]
    later.short = True
    with pytest.raises(UserError):
        bench.score(recording, methods={"later": later}, settings=QUICK, baselines=False)


def test_no_method_takes_the_name_of_another(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    methods = {"network and physics": lambda *inputs: bench.ForceEstimate(np.zeros(3))}
    with pytest.raises(UserError):
        bench.score(recording, methods=methods)
    install_methods(tmp_path, monkeypatch, physics="Push")
    with pytest.raises(UserError, match="physics"):
        comparison.simpler_methods()
