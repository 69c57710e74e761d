"""Slots on a Dask cluster: each of its workers has a worker process of its own, like the local engine.

Requires the extra `cluster`. The dataset's folder must be on a file system that all machines share.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from synth.dataset import provenance
from synth.dataset.dataset_folder import Folder
from synth.engine.child import Attempt, Child, Setup, environment, share_of_memory
from synth.errors import UserError
from synth.job.schema import Job
from synth.system import checked_file
from synth.system.stopwatch import StageCallback

_TICK_S = 0.5
_WAIT_FOR_WORKERS_S = 600
_CONNECT = "20s"
_LACKING = "needs the extra `cluster`: pip install '.[cluster]' in the clone"

_thread = threading.local()  # on a Dask worker: setup and child of each of its threads


@contextmanager
def open_slots(engine: str, setup: Setup) -> Iterator[list[Child]]:
    """The slots of `dask://host:port`, `tls://host:port`, or of a SLURM cluster described in a YAML file.

    Whoever can connect to a scheduler can run code on it: a note on stderr warns if others can. UserError:
    the extra is not installed, no scheduler answers, the file is wrong, or `tls://` without Dask's
    certificates.
    """
    try:
        import distributed
    except ImportError:
        raise UserError(f"a Dask engine {_LACKING}") from None
    # The lock can't be sent to other machines; workers detect the end of their run by the turn.
    remote_setup = replace(
        setup, lock_fd=None, environment={}, memory_bytes=None, generator=provenance.fingerprint()
    )
    with _cluster(engine) as (address, expected, security):
        try:
            client = distributed.Client(address, timeout=_CONNECT, security=security)
        except (OSError, TimeoutError, ValueError) as error:
            raise UserError(f"{engine}: no Dask scheduler answers ({error})") from error
        except (TypeError, RuntimeError) as error:
            raise UserError(f"{engine}: Dask's configuration lacks certificates ({error})") from error
        with client:
            try:
                client.wait_for_workers(1, timeout=_WAIT_FOR_WORKERS_S)
            except TimeoutError:
                raise UserError(f"{engine}: no worker has joined") from None
            # At least one slot waits, even if the last worker has just left.
            yield [_DaskSlot(client, remote_setup)] * max(sum(client.nthreads().values()), expected, 1)


class _DaskSlot(Child):
    """A thread of the cluster's workers, whose processes end themselves when the turn changes."""

    def __init__(self, client: Any, setup: Setup) -> None:
        super().__init__(setup)
        self._client = client

    def run(self, index: int, report: StageCallback, stop: threading.Event) -> Attempt:
        report("on the cluster", 0, 1)
        future = self._client.submit(_attempt, self._setup, index, pure=False)
        try:
            while not future.done():
                if stop.wait(_TICK_S):
                    future.cancel()
                    return Attempt(index, "stopped")
            if future.status == "finished":
                return Attempt(**future.result())
            error = str(future.exception() if future.status == "error" else "") or "no reason given"
            why = f"{future.status}: {error.splitlines()[0]}"
            return Attempt(index, "crash", f"the cluster lost it ({why})")
        finally:
            future.release()


def _attempt(setup: Setup, index: int) -> dict[str, Any]:
    """One attempt, on a Dask worker. Returns the Attempt's fields as a dict of plain values."""
    from distributed import get_worker

    stop, ended = threading.Event(), threading.Event()
    watch = threading.Thread(target=_stop_when_passed, args=(setup, stop, ended), daemon=True)
    watch.start()
    try:
        child = _child(setup, get_worker().state.nthreads)
        return vars(child.run(index, lambda stage, done, of: None, stop))
    finally:
        ended.set()
        watch.join()


def _child(setup: Setup, threads: int) -> Child:
    """This thread's child; a new one for another run."""
    if getattr(_thread, "setup", None) != setup:
        if hasattr(_thread, "child"):
            _thread.child.close()
        variables = environment(Job.model_validate(setup.job), threads)
        local_setup = replace(setup, environment=variables, memory_bytes=share_of_memory(threads))
        _thread.setup, _thread.child = setup, Child(local_setup)
    child: Child = _thread.child
    return child


def _stop_when_passed(setup: Setup, stop: threading.Event, ended: threading.Event) -> None:
    """Sets `stop` when another run of the dataset has begun: the engine of this one is gone."""
    while not ended.wait(_TICK_S):
        with suppress(OSError, ValueError):  # being rewritten, or the file system is briefly unavailable
            if int(Folder(setup.folder).turn_file.read_text()) != setup.turn:
                stop.set()
                return


@contextmanager
def _cluster(engine: str) -> Iterator[tuple[str, int, Any]]:
    """Yields the scheduler's address, the expected number of slots, and certificates if not configured."""
    target = engine if engine.startswith(("dask://", "tls://")) else read_slurm(Path(engine))
    if risk := describe_risk(target):
        print(f"note: {risk}: anyone in that network can run code there", file=sys.stderr)
    if isinstance(target, str):
        yield target.replace("dask://", "tcp://", 1), 0, None
        return
    jobs = int(target.pop("jobs"))
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise UserError(f"a SLURM engine {_LACKING}") from None
    try:
        cluster = SLURMCluster(**target)  # no job is submitted yet
    except (TypeError, ValueError) as error:
        raise UserError(f"{engine}: is not accepted by dask-jobqueue ({error})") from error
    with cluster:
        cluster.scale(jobs=jobs)
        yield cluster.scheduler_address, jobs * int(target["cores"]), cluster.security


def describe_risk(cluster: str | dict[str, Any]) -> str:
    """A warning if others could run code on a cluster, else empty. UserError: no host or port."""
    if isinstance(cluster, str):
        kind, _, place = cluster.partition("://")
        host, _, port = place.rpartition(":")
        if not host or not (port.isascii() and port.isdigit()):
            raise UserError(f"{cluster}: write the address as {kind}://host:port")
        local = host in ("localhost", "[::1]") or host.startswith("127.")
        return "" if kind == "tls" or local else f"{host} is reached unencrypted (tls://... is not)"
    scheduler = cluster.get("scheduler_options")
    keys = {*cluster, *(scheduler if isinstance(scheduler, dict) else ())}
    risks = {
        "the scheduler listens on every interface (`interface:`)": not {"interface", "host"} & keys,
        "it is reached unencrypted (`security: true`)": not cluster.get("security"),
    }
    return " and ".join(risk for risk, holds in risks.items() if holds)


def read_slurm(path: Path) -> dict[str, Any]:
    """`jobs` and the arguments of dask_jobqueue.SLURMCluster. UserError for a file without them."""
    if not os.path.lexists(path):
        raise UserError(f"{path}: is neither local, dask://host:port, tls://host:port nor a file")
    config = checked_file.read_yaml(path)
    if not isinstance(config, dict) or not isinstance(config.get("jobs"), int) or config["jobs"] < 1:
        raise UserError(f"{path}: must contain `jobs`, the number of jobs to submit")
    if missing := {"cores", "memory"} - config.keys():
        raise UserError(f"{path}: must contain {' and '.join(sorted(missing))} of a job")
    return dict(config)
