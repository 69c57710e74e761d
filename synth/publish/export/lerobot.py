"""LeRobot v3.0 (github.com/huggingface/lerobot): an episode a sequence, video as MP4, force by frame.

The dense truth (flow, traction, depth) has no place in it; `--to hf` and `--to webdataset` hold that.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from synth.dataset.index import group_by_side, row_of
from synth.dataset.store import Dataset, Sequence
from synth.publish.export.encoding import PICTURES
from synth.video.write import encode_video

_VERSION = "v3.0"
_FILES = 1000  # in a folder
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_QUALITY, _GROUP = 18, 2  # any frame is decoded from at most one before it
_PROBED = 100  # frames of an episode that the statistics of its pictures come from
_COUNTS = ("timestamp", "frame_index", "episode_index", "index", "task_index")

Numbers = NDArray[Any]


@dataclass(frozen=True)
class _Episode:
    """One sequence as an episode."""

    number: int
    start: int
    """Rows before it."""
    sequence: Sequence
    task: str

    @property
    def place(self) -> dict[str, int]:
        return {"chunk_index": self.number // _FILES, "file_index": self.number % _FILES}


def write_episodes(dataset: Dataset, target: Path) -> None:
    """`meta/`, `data/chunk-000/file-000.parquet` and `videos/KEY/chunk-000/file-NNN.mp4`, one an episode.

    Features: `observation.images.left` (and `.right`: the second lens) as video, `force` (3,) mN in camera
    axes, `young_kpa` and `scale_mm_per_px` (1,). There is no action: nobody steered a robot. The task says
    gesture and look. Sides of `synth split` are the ranges under `splits`.
    """
    tasks, about, ranges, rows = list[str](), list[dict[str, Any]](), dict[str, str](), 0
    for side, positions in group_by_side(dataset).items():
        ranges[side] = f"{len(about)}:{len(about) + len(positions)}"
        for sequence in map(dataset.__getitem__, positions):
            row = row_of(sequence)
            task = f"{row['gesture']} the brain surface ({row['family']})"
            tasks += [task] if task not in tasks else []
            episode = _Episode(len(about), rows, sequence, task)
            _write_videos(episode, target)
            frames = _rows(episode, tasks.index(task))
            columns = {
                name: pa.array(list(values), pa.list_(pa.float32(), 3))
                if name == "force"
                else pa.array(values)
                for name, values in frames.items()
            }
            _write_table(pa.table(columns), target / "data" / f"{_FILE.format(**episode.place)}.parquet")
            about.append(_describe(episode, frames))
            rows += sequence.frames
    _write_meta(dataset[0], about, tasks, ranges, target)


def _key(name: str) -> str:
    return f"observation.images.{'right' if name == 'rgb_right' else 'left'}"


def _cameras(sequence: Sequence) -> Iterator[str]:
    return (name for name in PICTURES if name in sequence)


def _write_videos(episode: _Episode, target: Path) -> None:
    for name in _cameras(episode.sequence):
        file = target / "videos" / _key(name) / f"{_FILE.format(**episode.place)}.mp4"
        file.parent.mkdir(parents=True, exist_ok=True)
        fps = float(episode.sequence.attrs["fps"])
        encode_video(file, episode.sequence[name][:], fps, quality=_QUALITY, group=_GROUP)


def _rows(episode: _Episode, task: int) -> dict[str, Numbers]:
    """The columns of an episode's frames, (T,) or (T, 3)."""
    attrs, frame = episode.sequence.attrs, np.arange(episode.sequence.frames)
    return {
        "force": episode.sequence["force"][:].astype(np.float32),
        "young_kpa": np.full(len(frame), attrs["young_kpa"], np.float32),
        "scale_mm_per_px": np.full(len(frame), attrs["scale_mm_per_px"], np.float32),
        "timestamp": (frame / float(attrs["fps"])).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full_like(frame, episode.number),
        "index": episode.start + frame,
        "task_index": np.full_like(frame, task),
    }


def _describe(episode: _Episode, columns: dict[str, Numbers]) -> dict[str, Any]:
    """The row of an episode in `meta/episodes`."""
    frames = episode.sequence.frames
    place: dict[str, Any] = {f"data/{name}": value for name, value in episode.place.items()}
    for name in _cameras(episode.sequence):
        video = f"videos/{_key(name)}"
        place |= {f"{video}/{what}": value for what, value in episode.place.items()}
        end = frames / float(episode.sequence.attrs["fps"])
        place |= {f"{video}/from_timestamp": 0.0, f"{video}/to_timestamp": end}
    return {
        "episode_index": episode.number,
        "tasks": [episode.task],
        "length": frames,
        "dataset_from_index": episode.start,
        "dataset_to_index": episode.start + frames,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        **place,
        **{
            f"stats/{key}/{name}": value
            for key, stats in _statistics(episode.sequence, columns).items()
            for name, value in stats.items()
        },
    }


def _statistics(sequence: Sequence, columns: dict[str, Numbers]) -> dict[str, dict[str, Any]]:
    """Of every feature over an episode's frames; of pictures in 0..1 by channel, from some of them."""
    found = {name: _summary(values.reshape(len(values), -1), ()) for name, values in columns.items()}
    for name in _cameras(sequence):
        chosen = np.unique(np.linspace(0, sequence.frames - 1, _PROBED).round().astype(int))
        pixels = np.concatenate([sequence[name][int(t)][::4, ::4].reshape(-1, 3) for t in chosen])
        found[_key(name)] = _summary(pixels / 255, (1, 1)) | {"count": [len(chosen)]}
    return found


def _summary(values: Numbers, beyond: tuple[int, ...]) -> dict[str, Any]:
    """Statistics over the rows of (N, K), each (K, *beyond)."""
    told = {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        **{name: np.quantile(values, q, axis=0) for name, q in _QUANTILES.items()},
    }
    shaped = {name: np.asarray(one, float).reshape(-1, *beyond).tolist() for name, one in told.items()}
    return {**shaped, "count": [len(values)]}


def _pooled(rows: list[dict[str, Any]], key: str) -> dict[str, Any]:
    """Statistics of all episodes from theirs; quantiles as LeRobot pools them, by a weighted mean."""
    get = {
        name: np.array([row[f"stats/{key}/{name}"] for row in rows])
        for name in ("min", "max", "mean", "std", "count", *_QUANTILES)
    }
    count = get["count"][:, 0].astype(float)

    def mean(values: Numbers) -> Numbers:
        return np.asarray(np.average(values, axis=0, weights=count))

    middle = mean(get["mean"])
    spread = np.sqrt(mean(get["std"] ** 2 + (get["mean"] - middle) ** 2))
    found = {"min": get["min"].min(0), "max": get["max"].max(0), "mean": middle, "std": spread}
    found |= {name: mean(get[name]) for name in _QUANTILES}
    return {**{name: value.tolist() for name, value in found.items()}, "count": [int(count.sum())]}


def _write_meta(
    first: Sequence, about: list[dict[str, Any]], tasks: list[str], ranges: dict[str, str], target: Path
) -> None:
    """`meta/info.json`, `stats.json`, `tasks.parquet` and the table of episodes."""
    height, width = (side // 2 * 2 for side in first.size)
    fps = float(first.attrs["fps"])
    features: dict[str, Any] = {}
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
    for name in _cameras(first):
        picture = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"]}
        features[_key(name)] = {**picture, "info": video}
    features["force"] = {"dtype": "float32", "shape": [3], "names": ["x_mn", "y_mn", "z_mn"]}
    for name in ("young_kpa", "scale_mm_per_px", *_COUNTS):
        kind = "int64" if name in _COUNTS[1:] else "float32"
        features[name] = {"dtype": kind, "shape": [1], "names": None}
    info = {
        "codebase_version": _VERSION,
        "robot_type": None,
        "total_episodes": len(about),
        "total_frames": sum(row["length"] for row in about),
        "total_tasks": len(tasks),
        "chunks_size": _FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(fps) if fps.is_integer() else fps,
        "splits": ranges,
        "data_path": f"data/{_FILE}.parquet",
        "video_path": f"videos/{{video_key}}/{_FILE}.mp4",
        "features": features,
    }
    meta = target / "meta"
    _write_table(pa.Table.from_pylist(about), meta / "episodes" / "chunk-000" / "file-000.parquet")
    (meta / "info.json").write_text(json.dumps(info, indent=4), "utf-8")
    stats = {key: _pooled(about, key) for key in features}
    (meta / "stats.json").write_text(json.dumps(stats, indent=4), "utf-8")
    _write_table(_indexed(tasks), meta / "tasks.parquet")


def _indexed(tasks: list[str]) -> pa.Table:
    """The tasks as pandas writes a table whose index they are, for LeRobot looks a task up by its text."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    columns = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"},
    ]
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [{**column, "metadata": None} for column in columns],
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _write_table(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="snappy")
