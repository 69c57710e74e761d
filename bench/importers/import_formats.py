"""The formats of `bench import`, and who reads them; without the libraries that do."""

from __future__ import annotations

from synth.plugins import Registry
from synth.video.suffixes import SUFFIXES

BAG, PLAIN = "bench.importers.rosbag:read_source", "bench.importers.plain_files:read_source"
_OWN = {
    "mha": "bench.importers.igsio:read_source",
    **dict.fromkeys(("bag", "mcap", "db3"), BAG),
    **dict.fromkeys(("h5", "hdf5"), "bench.importers.hdf5:read_source"),
    **dict.fromkeys(("npy", "tif", "tiff", "dcm", "dicom", *(ending[1:] for ending in SUFFIXES)), PLAIN),
}
IMPORTERS = Registry("sulcus.importers", "bench import", "format", _OWN)
"""Readers by the ending of a file's name, without the dot. An entry point is a function of a path, and of
names in the source by role, that returns a `bench.Intake`."""


def list_endings() -> str:
    """The endings for people, without those of videos."""
    return ", ".join(f".{name}" for name in IMPORTERS.names() if f".{name}" not in SUFFIXES)
