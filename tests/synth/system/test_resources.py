"""Cores and memory by affinity and control groups, in made trees of `/proc` and `/sys`."""

from pathlib import Path

import pytest

from synth.system import resources

GB = 1024**3
NONE = "9223372036854771712"  # version 1, without a limit


@pytest.fixture(autouse=True)
def _host(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(64)))


def make_tree(root: Path, groups: str, **files: str) -> Path:
    """A host of 256 GB, of which 200 are free, with control groups; `__` in a name stands for `/`."""
    kb = GB // 1024
    info = f"MemTotal: {256 * kb} kB\nMemAvailable: {200 * kb} kB\nHugePages_Total: 0\n"
    contents = {"proc/meminfo": info, "proc/self/cgroup": groups}
    contents |= {f"sys/fs/cgroup/{name}": text for name, text in files.items()}
    for name, text in contents.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_without_control_groups_the_host_counts(tmp_path: Path) -> None:
    root = make_tree(tmp_path, "")
    assert (resources.cores(root), resources.memory(root)) == (64, 256 * GB)
    assert resources.free_memory(root) == 200 * GB
    assert resources.cores(tmp_path / "nothing") == 64


def test_a_container_of_version_2_sees_its_own_group_at_the_top(tmp_path: Path) -> None:
    files = {
        "cpu.max": "200000 100000\n",
        "memory.max": f"{4 * GB}\n",
        "memory.current": f"{3 * GB}\n",
        "memory.stat": f"anon {2 * GB}\ninactive_file {GB}\n",
    }
    root = make_tree(tmp_path, "0::/\n", **files)
    assert (resources.cores(root), resources.memory(root)) == (2, 4 * GB)
    assert resources.free_memory(root) == 2 * GB


def test_the_tightest_group_on_the_way_up_counts(tmp_path: Path) -> None:
    files = {
        "user/job/cpu.max": "max 100000",
        "user/job/memory.max": f"{8 * GB}",
        "user/job/memory.current": f"{GB}",
        "user/cpu.max": "150000 100000",
        "user/memory.max": "max",
        "user/memory.current": f"{100 * GB}",
    }
    root = make_tree(tmp_path, "0::/user/job\n", **files)
    assert resources.cores(root) == 2  # one and a half
    assert (resources.memory(root), resources.free_memory(root)) == (8 * GB, 7 * GB)


def test_a_container_of_version_1_whose_path_is_the_hosts(tmp_path: Path) -> None:
    groups = "12:cpu,cpuacct:/docker/abc\n5:memory:/docker/abc\n1:name=systemd:/docker/abc\n0::/\n"
    files = {
        "cpu,cpuacct/cpu.cfs_quota_us": "50000",
        "cpu,cpuacct/cpu.cfs_period_us": "100000",
        "memory/memory.limit_in_bytes": f"{4 * GB}",
        "memory/memory.usage_in_bytes": f"{5 * GB}",
        "memory/memory.stat": f"cache {2 * GB}\ntotal_inactive_file {2 * GB}",
    }
    root = make_tree(tmp_path, groups, **files)
    assert resources.cores(root) == 1
    assert (resources.memory(root), resources.free_memory(root)) == (4 * GB, GB)


def test_groups_without_limits_change_nothing(tmp_path: Path) -> None:
    groups = "12:cpuacct,cpu:/\n5:memory:/\n"
    files = {
        "cpu/cpu.cfs_quota_us": "-1",
        "cpu/cpu.cfs_period_us": "100000",
        "memory/memory.limit_in_bytes": NONE,
        "memory/memory.usage_in_bytes": f"{5 * GB}",
    }
    root = make_tree(tmp_path, groups, **files)
    assert (resources.cores(root), resources.memory(root)) == (64, 256 * GB)
    assert resources.free_memory(root) == 200 * GB


def test_affinity_below_the_quota_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3})
    assert resources.cores(make_tree(tmp_path, "0::/\n", **{"cpu.max": "200000 100000"})) == 1
