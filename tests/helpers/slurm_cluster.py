"""A SLURM of one node with two slots on this machine, for as long as a test needs it."""

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

PROGRAMS = ("slurmctld", "slurmd", "sbatch", "scancel", "scontrol", "squeue")

_CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/none
CredType=cred/none
SlurmctldPort={controller}
SlurmdPort={daemon}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
MpiDefault=none
ReturnToService=2
SchedulerParameters=sched_interval=1,batch_sched_delay=0
StateSaveLocation={home}/state
SlurmdSpoolDir={home}/spool
SlurmctldPidFile={home}/slurmctld.pid
SlurmdPidFile={home}/slurmd.pid
SlurmctldLogFile={home}/slurmctld.log
SlurmdLogFile={home}/slurmd.log
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=16000 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> str:
    """Why there can be none here; empty if there can."""
    absent = [name for name in PROGRAMS if shutil.which(name) is None]
    if absent:
        return f"no {', '.join(absent)} here (Debian: apt-get install slurm-wlm)"
    return "" if os.geteuid() == 0 else "a node's daemon needs root"


def call(*words: str) -> str:
    """Output of one of SLURM's commands."""
    result = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, f"{' '.join(words)}: {result.stderr}"
    return result.stdout.strip()


@contextmanager
def slurm_cluster(home: Path) -> Iterator[str]:
    """The node's name; `SLURM_CONF` says where the cluster is, until the block ends."""
    host = socket.gethostname().split(".")[0]
    for name in ("state", "spool"):
        (home / name).mkdir(parents=True)
    with socket.socket() as first, socket.socket() as second:
        for free in (first, second):
            free.bind(("127.0.0.1", 0))
        ports = {"controller": first.getsockname()[1], "daemon": second.getsockname()[1]}
    (home / "slurm.conf").write_text(_CONFIGURATION.format(home=home, host=host, **ports))
    daemons: list[subprocess.Popen[bytes]] = []
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("SLURM_CONF", str(home / "slurm.conf"))
        try:
            for program in ("slurmctld", "slurmd"):
                log = (home / f"{program}.out").open("wb")
                daemons.append(subprocess.Popen([program, "-D"], stdout=log, stderr=log))
                log.close()
            _wait_for_node(daemons, home)
            yield host
        finally:
            for daemon in reversed(daemons):
                daemon.terminate()
            for daemon in daemons:
                try:
                    daemon.wait(timeout=20)
                except subprocess.TimeoutExpired:
                    daemon.kill()
                    daemon.wait(timeout=20)


def _wait_for_node(daemons: list[subprocess.Popen[bytes]], home: Path) -> None:
    until = time.monotonic() + 60
    while time.monotonic() < until:
        logs = "\n".join(path.read_text(errors="replace") for path in home.glob("*.out"))
        assert all(daemon.poll() is None for daemon in daemons), logs
        result = subprocess.run(["sinfo", "-h", "-o", "%T"], capture_output=True, text=True, timeout=60)
        if result.stdout.strip() == "idle":
            return
        time.sleep(0.5)
    raise AssertionError(f"the node never came up\n{logs}")
