"""What a file is that can't be imported, by its first bytes and its name, and what to do with it."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from synth.errors import UserError
from synth.system import checked_file

_LARGEST = 1 << 42
_FIRST_BYTES = {
    b"\x89MCAP0\r\n": ".mcap",
    b"#ROSBAG V2.0": ".bag",
    b"SQLite format 3": ".db3",
    b"\x89HDF\r\n": ".h5",
    b"\x93NUMPY": ".npy",
    b"II*\0": ".tif",
    b"MM\0*": ".tif",
    b"\x1aE\xdf\xa3": ".mkv",
    b"ObjectType": ".mha",
    b"NDims": ".mha",
    b"\x28\xb5\x2f\xfd": ".zst",
    b"\x1f\x8b": ".gz",
    b"PK\x03\x04": ".zip",
    b"TDSm": ".tdms",
    b"\x06\x0e\x2b\x34": ".mxf",
    b"YUV4MPEG2": ".y4m",
    b"GIF8": ".gif",
    b"MATLAB 5.0": ".mat",
    b"version https://git-lfs": "a pointer of Git LFS: git lfs pull fetches the file",
}
_SAME_FORMAT = {".hdf5": ".h5", ".tiff": ".tif", ".webm": ".mkv"}
_TO_VIDEO = "convert it without loss: ffmpeg -i {name} -c:v ffv1 {stem}.mkv"
_TABLE = "a table of forces: import the video, with --use force={name}"
_CURES = {
    **dict.fromkeys(
        (".mxf", ".y4m", ".gif", ".dv", ".vob", ".rm", ".mjpeg", ".mjpg", ".divx", ".f4v"), _TO_VIDEO
    ),
    **dict.fromkeys(
        (".h264", ".264", ".h265", ".265", ".hevc"),
        "packets without times: ffmpeg -framerate RATE -i {name} -c copy {stem}.mkv",
    ),
    **dict.fromkeys((".csv", ".txt", ".lvm", ".tsv", ".dat"), _TABLE),
    **dict.fromkeys(
        (".xlsx", ".xls", ".ods"), "save its sheet as CSV, and import the video with --use force="
    ),
    ".tdms": "export it as CSV (by LabVIEW, or TdmsFile(...).as_dataframe() of nptdms), then --use force=",
    **dict.fromkeys(
        (".svo", ".svo2"), "a recording of ZED cameras: export both videos by its SDK (ZED_SVO_Export)"
    ),
    **dict.fromkeys((".zst", ".zstd"), "unpack it first: zstd -d {name}"),
    **dict.fromkeys((".gz", ".bz2", ".xz", ".zip", ".7z", ".tar", ".rar"), "unpack it first"),
    ".active": "a bag of ROS 1 that was not closed: rosbag reindex {name}, then rename it to .bag",
    **dict.fromkeys((".part", ".crdownload", ".filepart", ".tmp"), "a copy or download that has not ended"),
    **dict.fromkeys(
        (".mhd", ".nrrd", ".nii"), "save it as one .mha, with Timestamp and Force of every frame"
    ),
    **dict.fromkeys(
        (".mat", ".pkl", ".lmdb", ".zarr"), "save its pictures as .npy or a video, its forces as CSV"
    ),
    **dict.fromkeys((".npz",), "save its pictures as .npy, its forces as CSV"),
    ".rosbag": "rename it to .bag if it is of ROS 1",
    ".braw": _TO_VIDEO,
    **dict.fromkeys((".jpg", ".jpeg", ".png", ".bmp"), "one picture: name the folder of all of them"),
}
_DAMAGED = {
    ".mcap": "cut off, as after a recorder's crash? mcap recover {name} -o {stem}-fixed.mcap mends it",
    ".bag": "not closed, as after a recorder's crash? rosbag reindex {name} mends it",
    ".db3": "not closed? sqlite3 {name} .recover mends it; keep its -wal and -journal files with it",
}


def explain_unknown(source: Path, known: list[str]) -> UserError:
    """That a source is no format that can be imported: what it is, and the way out."""
    formats = f"formats: {', '.join(known)}, a folder of pictures, of videos or of a ROS 2 bag"
    if source.is_dir():
        if (source / "meta.yaml").is_file():
            return UserError(f"{source}: is a recording folder already: bench check reads it as it is")
        if cure := _CURES.get(source.suffix.lower()):
            return UserError(f"{source}: {_fill_names(cure, source)}")
        contents = ", ".join(sorted(path.name for path in source.iterdir())[:6]) or "nothing"
        return UserError(
            f"{source}: a folder without pictures, videos or a bag; it holds {contents}; {formats}"
        )
    suffix, kind = source.suffix.lower(), find_format(source)
    if kind.startswith("."):
        cure = _CURES.get(suffix) or _CURES.get(kind) or f"rename it to {source.stem}{kind}"
        if kind in known and suffix not in _CURES:
            cure = f"it is a {kind} by its first bytes: rename it"
        return UserError(f"{source}: {_fill_names(cure, source)}")
    if cure := _CURES.get(suffix):
        return UserError(f"{source}: {_fill_names(cure, source)}")
    return UserError(f"{source}: not a format that can be imported ({kind}); {formats}")


def explain_unreadable(source: Path, reason: str) -> UserError:
    """That a library can't read a source of a known name, with what it found."""
    if source.is_dir():
        return UserError(f"{source}: can't be read ({reason})")
    suffix, kind = source.suffix.lower(), find_format(source)
    if kind == _SAME_FORMAT.get(suffix, suffix):
        cure = _DAMAGED.get(kind, "is it cut off? Copy it again")
        return UserError(f"{source}: can't be read to its end ({reason}); {_fill_names(cure, source)}")
    if kind.startswith("."):
        return UserError(f"{source}: is named {suffix}, but is a {kind} by its first bytes ({reason})")
    return UserError(f"{source}: can't be read as {suffix} ({reason}); {kind}")


def find_format(source: Path) -> str:
    """The usual suffix of a file's format by its first bytes, else in words what it begins with."""
    head = b""
    with suppress(UserError), checked_file.open_file(source, _LARGEST) as file:
        head = file.read(140)
    if head[4:8] == b"ftyp":
        return ".mp4"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return ".avi"
    if head[128:132] == b"DICM":
        return ".dcm"
    for start, name in _FIRST_BYTES.items():
        if head.startswith(start):
            return name
    if not head:
        return "it is empty"
    text = head[:40]
    return f"it begins with {text.decode('latin-1')!a}"


def _fill_names(cure: str, source: Path) -> str:
    return cure.format(name=source.name, stem=source.stem)
