"""Export to LeRobot v3.0 (github.com/huggingface/lerobot): an episode per sequence, MP4, force per frame.

The format has no dense fields (flow, traction, depth); `--to hf` and `--to webdataset` export them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from synth.arrays import Array
from synth.dataset.index import group_by_side, row_of
from synth.dataset.store import Dataset, Sequence
from synth.publish.export.encoding import PICTURES
from synth.video.write import encode_video

_FILES = 1000  # per folder
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA_PATH = f"data/{_FILE}.parquet"
_VIDEO_PATH = f"videos/{{video_key}}/{_FILE}.mp4"
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_QUALITY, _GROUP = 18, 2  # with a key frame every two frames, random access is fast
_PROBED = 100  # frames of an episode for the statistics of its pictures
_COUNTS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def write_episodes(dataset: Dataset, target: Path) -> None:
    """Writes `meta/`, and per episode `data/chunk-000/file-NNN.parquet` and `videos/KEY/.../file-NNN.mp4`.

    Features: `observation.images.left` (and `.right`) as video, `force` (3,) mN in camera axes, `young_kpa`
    and `scale_mm_per_px` (1,). There are no actions, as there is no robot. The task is gesture and
    appearance. The sides of the split are ranges in `splits`.
    """
    tasks, episodes, ranges = list[str](), list[dict[str, Any]](), dict[str, str]()
    for side, positions in group_by_side(dataset).items():
        ranges[side] = f"{len(episodes)}:{len(episodes) + len(positions)}"
        for sequence in map(dataset.__getitem__, positions):
            before = episodes[-1]["dataset_to_index"] if episodes else 0
            episodes.append(_write_episode(sequence, len(episodes), before, tasks, target))
    _write_meta(dataset[0], episodes, tasks, ranges, target)


def _cameras(sequence: Sequence) -> dict[str, str]:
    """Video features and their fields."""
    named = zip(("left", "right"), PICTURES, strict=True)
    return {f"observation.images.{key}": name for key, name in named if name in sequence}


def _write_episode(
    sequence: Sequence, number: int, before: int, tasks: list[str], target: Path
) -> dict[str, Any]:
    """Writes the frames and videos of an episode after `before` rows; returns its row of `meta/episodes`."""
    about = row_of(sequence)
    task = f"{about['gesture'] or 'move'} the brain surface ({about['family']})"
    tasks += [task] if task not in tasks else []
    frames, fps = sequence.frames, float(sequence.attrs["fps"])
    frame = np.arange(frames)
    columns: dict[str, Array] = {
        "force": sequence["force"][:].astype(np.float32),
        "young_kpa": np.full(frames, sequence.attrs["young_kpa"], np.float32),
        "scale_mm_per_px": np.full(frames, sequence.attrs["scale_mm_per_px"], np.float32),
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full_like(frame, number),
        "index": before + frame,
        "task_index": np.full_like(frame, tasks.index(task)),
    }
    stats = {name: _statistics(values.reshape(frames, -1), ()) for name, values in columns.items()}
    place = {"chunk_index": number // _FILES, "file_index": number % _FILES}
    vector = pa.list_(pa.float32(), 3)
    arrays = {
        name: pa.array(list(values), vector) if values.ndim == 2 else pa.array(values)
        for name, values in columns.items()
    }
    _write_table(pa.table(arrays), target / _DATA_PATH.format(**place))
    row: dict[str, Any] = {
        "episode_index": number,
        "tasks": [task],
        "length": frames,
        "dataset_from_index": before,
        "dataset_to_index": before + frames,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        **{f"data/{name}": value for name, value in place.items()},
    }
    probed = np.unique(np.linspace(0, frames - 1, _PROBED).round().astype(int)).tolist()
    for key, name in _cameras(sequence).items():
        video = target / _VIDEO_PATH.format(video_key=key, **place)
        video.parent.mkdir(parents=True, exist_ok=True)
        encode_video(video, sequence[name][:], fps, quality=_QUALITY, group=_GROUP)
        row |= {f"videos/{key}/{what}": value for what, value in place.items()}
        row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": frames / fps}
        pixels = np.concatenate([sequence[name][t][::4, ::4].reshape(-1, 3) for t in probed])
        stats[key] = _statistics(pixels / 255, (1, 1)) | {"count": [len(probed)]}
    return row | {f"stats/{key}/{name}": value for key, one in stats.items() for name, value in one.items()}


def _statistics(values: Array, beyond: tuple[int, ...]) -> dict[str, Any]:
    """Statistics over the rows of (N, K), each (K, *beyond)."""
    found = {name: getattr(values, name)(0) for name in ("min", "max", "mean", "std")}
    found |= {name: np.quantile(values, q, axis=0) for name, q in _QUANTILES.items()}
    shaped = {name: np.asarray(one, float).reshape(-1, *beyond).tolist() for name, one in found.items()}
    return {**shaped, "count": [len(values)]}


def _pooled(rows: list[dict[str, Any]], key: str) -> dict[str, Any]:
    """Statistics of all episodes, pooled from those of each; quantiles by a weighted mean, as in LeRobot."""
    names = ("min", "max", "mean", "std", "count", *_QUANTILES)
    get = {name: np.array([row[f"stats/{key}/{name}"] for row in rows]) for name in names}
    count = get["count"][:, 0].astype(float)
    found = {"min": get["min"].min(0), "max": get["max"].max(0)}
    found |= {name: np.average(get[name], axis=0, weights=count) for name in ("mean", "std", *_QUANTILES)}
    squares = get["std"] ** 2 + (get["mean"] - found["mean"]) ** 2
    found["std"] = np.sqrt(np.average(squares, axis=0, weights=count))
    return {name: value.tolist() for name, value in found.items()} | {"count": [int(count.sum())]}


def _write_meta(
    first: Sequence, about: list[dict[str, Any]], tasks: list[str], ranges: dict[str, str], target: Path
) -> None:
    """Writes `meta/info.json`, `stats.json`, `tasks.parquet` and the table of episodes."""
    height, width = (side // 2 * 2 for side in first.size)
    fps = float(first.attrs["fps"])
    video = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": int(fps),
        "video.channels": 3,
        "has_audio": False,
    }
    picture = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {key: {**picture, "info": video} for key in _cameras(first)}
    features["force"] = {"dtype": "float32", "shape": [3], "names": ["x_mn", "y_mn", "z_mn"]}
    for name in ("young_kpa", "scale_mm_per_px", *_COUNTS):
        kind = "int64" if name in _COUNTS[1:] else "float32"
        features[name] = {"dtype": kind, "shape": [1], "names": None}
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(about),
        "total_frames": sum(row["length"] for row in about),
        "total_tasks": len(tasks),
        "chunks_size": _FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(fps) if fps.is_integer() else fps,
        "splits": ranges,
        "data_path": _DATA_PATH,
        "video_path": _VIDEO_PATH,
        "features": features,
    }
    meta = target / "meta"
    meta.mkdir()
    (meta / "info.json").write_text(json.dumps(info, indent=4), "utf-8")
    _write_table(pa.Table.from_pylist(about), meta / "episodes" / "chunk-000" / "file-000.parquet")
    stats = {key: _pooled(about, key) for key in features}
    (meta / "stats.json").write_text(json.dumps(stats, indent=4), "utf-8")
    _write_table(_indexed(tasks), meta / "tasks.parquet")


def _indexed(tasks: list[str]) -> pa.Table:
    """The tasks as a pandas table indexed by their texts, by which LeRobot looks them up."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
        for name, kind, stored in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _write_table(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="snappy")
