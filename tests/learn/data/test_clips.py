import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import phantom
import pytest
from safetensors import SafetensorError

from learn.data.clips import Clip, load_clips, pack, unpack
from learn.data.grid import Grid
from learn.split import groups
from synth.dataset.sequence_split import name_anatomy
from synth.dataset.store import Dataset
from synth.errors import UserError

GRID = Grid(32)


@pytest.mark.slow
def test_force_density_times_cell_times_stiffness_is_the_force(clips: list[Clip]) -> None:
    for clip in clips:
        total = clip.density.sum((2, 3)) * GRID.pitch_mm**2 * clip.young_kpa
        np.testing.assert_allclose(total, clip.force, atol=0.01 * np.abs(clip.force).max())
        assert np.abs(clip.force[3]).max() > 0


def test_displacement_is_in_mm(clips: list[Clip], dataset: Path) -> None:
    flow = Dataset(dataset)[0]["flow"][3]
    largest = np.linalg.norm(flow, axis=2).max() * phantom.SCALE_MM_PER_PX
    peak_mm = np.linalg.norm(clips[0].displacement["ideal"][3], axis=0).max()
    assert peak_mm == pytest.approx(largest, rel=0.1)
    assert not np.array_equal(clips[0].displacement["recovered"][3], clips[0].displacement["ideal"][3])


def test_packed_clips_are_equal_and_another_version_packs_anew(
    dataset: Path, clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(2):
        packed = load_clips(dataset, GRID, ("ideal", "recovered"), cache=tmp_path)
    for a, b in zip(clips, packed, strict=True):
        np.testing.assert_array_equal(a.displacement["recovered"], b.displacement["recovered"])
        for name in ("mask", "density", "force"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
            assert not getattr(b, name).flags.writeable
        assert (a.name, a.group, a.young_kpa) == (b.name, b.group, b.young_kpa)
    assert len(list(tmp_path.iterdir())) == len(clips)
    monkeypatch.setattr("learn.data.clips.CLIPS", "another")
    load_clips(dataset, GRID, ("ideal", "recovered"), cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2 * len(clips)


def test_two_runs_may_pack_the_same_at_once(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename

    def rename_late(part: Path, to: Path) -> Path:
        monkeypatch.setattr(Path, "rename", rename)
        pack(clips[0], to)  # another run finishes meanwhile
        return rename(part, to)

    monkeypatch.setattr(Path, "rename", rename_late)
    pack(clips[0], tmp_path / "packed")
    assert [path.name for path in tmp_path.iterdir()] == ["packed"]
    np.testing.assert_array_equal(unpack(tmp_path / "packed").density, clips[0].density)


def test_a_full_disk_is_one_line_and_leaves_nothing(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_to_save(*about: object) -> None:
        raise SafetensorError("Error while serializing: I/O error: No space left on device")

    monkeypatch.setattr("learn.data.clips.save_file", fail_to_save)
    with pytest.raises(UserError):
        pack(clips[0], tmp_path / "packed")
    assert not any(tmp_path.iterdir())


def test_a_packed_clip_holds_no_file_open_and_one_mapping(clips: list[Clip], tmp_path: Path) -> None:
    """A process may have a thousand files open and 65,530 mappings; datasets have thousands of sequences."""

    def count_mappings() -> int:
        return Path("/proc/self/maps").read_text().count(str(tmp_path))

    pack(clips[0], tmp_path / "packed")
    unpack(tmp_path / "packed")
    before, unpacked = len(os.listdir("/proc/self/fd")), [unpack(tmp_path / "packed") for _ in range(20)]
    assert len(os.listdir("/proc/self/fd")) == before
    assert count_mappings() == len(unpacked)


def test_a_store_without_recovered_flow(tmp_path: Path) -> None:
    phantom.write(tmp_path, 0, anatomy_seed=1, recovered=False)
    with pytest.raises(UserError, match=r"flow_recovered.*ideal"):
        load_clips(tmp_path, GRID, ("recovered",))
    with pytest.raises(UserError, match="motion_recovered") as caught:
        load_clips(tmp_path, GRID, ("motion",))
    assert "--input" not in str(caught.value), "a stereo model can't use monocular flow"
    assert len(load_clips(tmp_path, GRID, ("ideal",))) == 1


def test_copies_of_a_sequence_are_one_group_whatever_their_anatomy(clips: list[Clip]) -> None:
    twin = replace(clips[0], group="another")
    other = replace(clips[5], group="another")
    number = groups([*clips, twin, other])
    assert number[0] == number[1] == number[-1] == number[-2] == number[5]

    assert name_anatomy({"content_hash": "h", "anatomy_id": "mesh-5f"}) == "mesh-5f"
    assert name_anatomy({"content_hash": "h"}) == "h"
