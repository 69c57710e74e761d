"""Execution of a job: sequences are distributed to worker processes, and their order has no effect."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any

from synth.arguments import checked
from synth.dataset import index, size_forecast
from synth.dataset.dataset_folder import Folder, Part, claim
from synth.engine.child import Attempt, Child, Setup, choose_gpus, environment, share_of_memory
from synth.engine.compilation import compile_once
from synth.engine.journal import Journal, RunBars, Watcher
from synth.errors import UserError, as_positive
from synth.job.reader import as_job
from synth.job.schema import Job
from synth.publish import card
from synth.system import resources

_TRIES = 3  # attempts per sequence
_VERDICT = 5  # the job is refused if so many sequences fail because of it before any succeeds


@dataclass(frozen=True)
class Options:
    """Options of a run; none of them changes a byte of the dataset."""

    engine: str = "local"  # or dask://host:port, tls://host:port, a YAML file that describes a SLURM cluster
    workers: int | None = None  # number of processes; None: one per core
    gpus: str = "auto"  # GPUs of this machine that the workers share: `auto`, `none`, or their numbers, `0,1`
    memory_gb: float | None = None  # limit of one process; None: an equal share of the available memory
    work: str = "synth.sequence.pipeline:render_sequence"  # `module:function` that computes one sequence
    mix_versions: bool = False  # continue a dataset that another version of the program began
    part: Part | None = None  # of the sequences, that this run computes, beside runs of other parts

    def __post_init__(self) -> None:
        for name in ("workers", "memory_gb"):
            if getattr(self, name) is not None:
                as_positive(name, getattr(self, name))
        if self.part is not None and self.engine != "local":
            raise UserError(f"--part is of one machine's run, not for --engine {self.engine}")


@dataclass(frozen=True)
class Summary:
    """The result of a run."""

    total: int
    """Sequences of the job, or of the part."""
    already: int
    """Sequences that were finished before."""
    done: int
    """Sequences finished by this run."""
    failed: dict[int, str]
    """Reason of every failed sequence, of this run and of earlier ones."""
    content_hash: str
    """Hash of the content hashes of all finished sequences in order; empty while other parts are computed."""
    cautions: dict[str, list[int]] = field(default_factory=dict)
    """What is doubtful about the mechanics of another program, and the finished sequences of which it is."""


@checked
def render_job(
    job: Job | str | Path, out: str | Path, *, progress: bool | Watcher = False, **options: Any
) -> Summary:
    """Renders the dataset of a job into a folder; an existing one of the same job is continued.

    Sequences are computed in separate processes, so this works from a notebook too. A failed sequence does
    not end the run: `Summary.failed` has its reason.

    Args:
        job: the job, or a path or name for `load_job`.
        out: the folder.
        progress: True draws bars, in a terminal or a notebook; a `Watcher` is called with the run's events.
        options: as the command's: `workers`, `engine`, `gpus`, `memory_gb`, `mix_versions`.

    Raises:
        UserError: the folder is not for this job, the disk is full, or the job cannot be carried out.
    """
    job = as_job(job)
    run_options = checked(Options)(**options)
    if progress is True:
        with RunBars() as bars:
            return run_job(job, Path(out), run_options, bars)
    return run_job(job, Path(out), run_options, progress or Watcher())


def run_job(job: Job, root: Path, options: Options, watcher: Watcher) -> Summary:
    """Computes the sequences of `job` that `root` lacks; raises as `render_job`.

    Of a job that can't be carried out nothing is left. KeyboardInterrupt: when the workers have ended.
    """
    workers, memory = options.workers or resources.cores(), options.memory_gb
    share = share_of_memory(workers) if memory is None else int(memory * 1e9)
    if options.engine == "local" and options.work == Options.work:  # the memory of other work is unknown
        size_forecast.refuse_if_too_long(job, share, workers)
    if job.render.calibration is not None:
        from synth.sequence.draw import refuse_unfit  # slow to import

        refuse_unfit(job.render)
    gpus = choose_gpus(options.gpus, job.render.variant == "cuda_ad_rgb")
    with claim(root, job, mix_versions=options.mix_versions, part=options.part) as folder:
        indices = [index for index in range(job.sequences) if folder.computes(index)]
        finished = [index for index in folder.list_sealed() if folder.computes(index)]
        failures = {index: failure for index, failure in folder.failures().items() if folder.computes(index)}
        todo = sorted(set(indices) - set(finished) - set(failures))
        size_forecast.refuse_if_too_large(size_forecast.forecast_rest(job, root, len(todo), finished), root)
        watchers = (Journal(folder, workers, watcher.account), watcher)
        for observer in watchers:
            observer.begin(len(indices), len(finished), len(failures))
        setup = Setup(
            job=job.model_dump(mode="json"),
            folder=root.resolve(),
            work=options.work,
            memory_bytes=share,
            lock_fd=folder.lock_fd,
            environment=environment(job, workers),
            turn=folder.turn,
        )
        if todo and options.engine == "local" and options.work == Options.work:
            compile_once(setup.environment, resources.cores(), watcher.prepare)
        try:
            with _slots(options.engine, setup, workers, gpus) as slots:
                done = _Pool(folder, slots[: max(1, len(todo))], todo).work(watchers)
        finally:
            rows = _complete(folder, job)
        if folder.part is None and (done or not (root / "README.md").exists()):
            card.write_card(folder)
        completed = [key for key in folder.list_sealed() if folder.computes(key)]
        failed = {
            key: failure["reason"] for key, failure in folder.failures().items() if folder.computes(key)
        }
        return Summary(
            total=len(indices),
            already=len(finished),
            done=done,
            failed=failed,
            content_hash="" if rows is None else index.dataset_hash(rows),
            cautions={} if job.mechanics.source is None else index.list_cautions(root, completed),
        )


def _complete(folder: Folder, job: Job) -> list[dict[str, Any]] | None:
    """Writes the index of a dataset; of one in parts the part that ends last writes it, and the card.

    The split follows from all sequences together, so that it doesn't depend on the order of the parts.
    Returns the rows; None if other parts are not done.
    """
    if folder.part is None:
        return index.write_index(folder)
    with folder.gate():
        if set(range(job.sequences)) - set(folder.list_sealed()) - set(folder.failures()):
            return None
        rows = index.write_index(folder)
        card.write_card(folder)
        return rows


@checked
@contextmanager
def open_dataset(root: str | Path, job: Job | str | Path) -> Iterator[Path]:
    """A folder for custom scenes, written by `write_scene`; index and card are written at the end.

    Example:
        with synth.open_dataset("out", job) as folder:
            synth.write_scene(synth.simulate(job, 0, motions=[circle]), folder)

    Raises:
        UserError: the folder is not for this job.
    """
    block_error: BaseException | None = None
    try:
        with claim(Path(root), as_job(job)) as folder:
            try:
                yield folder.root
            except BaseException as error:
                block_error = error
                raise
            finally:
                index.write_index(folder)
            card.write_card(folder)
    except BaseException:
        if block_error is not None:  # not that of the cleaning after it
            raise block_error from block_error.__cause__
        raise


class _Pool:
    """Threads, each with its own slot, and the queue of sequences to compute."""

    def __init__(self, folder: Folder, slots: Sequence[Child], todo: list[int]) -> None:
        self._folder, self._slots = folder, slots
        self._todo = deque((k, 1) for k in todo)
        self._busy = 0
        self._change = threading.Condition()
        self._stop = threading.Event()
        # For the main thread: calls of watchers, an error, or None when a thread ends.
        self._events = queue.SimpleQueue[Callable[[Watcher], None] | BaseException | None]()
        self._done = 0
        self._refused: list[Attempt] = []

    def work(self, watchers: Iterable[Watcher]) -> int:
        """Runs until nothing is left to do; returns how many were finished."""
        threads = [threading.Thread(target=self._serve, args=(slot,), daemon=True) for slot in self._slots]
        for thread in threads:
            thread.start()
        try:
            alive = len(threads)
            while alive:
                event = self._events.get()
                if isinstance(event, BaseException):
                    raise event
                if event is None:
                    alive -= 1
                    continue
                for watcher in watchers:
                    event(watcher)
        finally:
            self._stop.set()
            with self._change:
                self._change.notify_all()
            for thread in threads:
                thread.join()
            self._folder.sweep_all()
        return self._done

    def _serve(self, slot: Child) -> None:
        try:
            while (task := self._take()) is not None:
                index, tries = task

                def report(stage: str, done: int, of: int, index: int = index) -> None:
                    self._events.put(lambda watcher: watcher.stage(index, stage, done, of))

                self._settle(slot.run(index, report, self._stop), tries)
        except BaseException as error:
            self._events.put(error)
        finally:
            slot.close()
            self._events.put(None)

    def _take(self) -> tuple[int, int] | None:
        """The next (sequence, attempt); waits while others may still be retried; None at the end."""
        with self._change:
            self._change.wait_for(lambda: self._stop.is_set() or self._todo or not self._busy)
            if self._stop.is_set() or not self._todo:
                return None
            self._busy += 1
            return self._todo.popleft()

    def _settle(self, attempt: Attempt, tries: int) -> None:
        if attempt.kind == "disk":
            raise UserError(f"{self._folder.root}: cannot be written ({attempt.reason})")
        self._done += attempt.kind == "done"
        retry = attempt.kind not in ("done", "input", "stopped") and tries < _TRIES
        if retry:
            self._folder.sweep(attempt.index)
        elif attempt.kind not in ("done", "stopped"):
            self._fail(attempt, tries)
        with self._change:
            if retry:
                self._todo.append((attempt.index, tries + 1))
            self._busy -= 1
            self._change.notify_all()
        self._events.put(lambda watcher: watcher.end(attempt, retry))

    def _fail(self, attempt: Attempt, tries: int) -> None:
        self._folder.mark_failed({**asdict(attempt), "tries": tries})
        if attempt.kind != "input":
            return
        with self._change:
            self._refused.append(attempt)
            remaining = self._done + len(self._todo) + self._busy - 1
            hopeless = not self._done and (len(self._refused) >= _VERDICT or not remaining)
        if hopeless and not self._folder.list_sealed():
            # The job itself is at fault: leave nothing behind.
            self._folder.clear_failures(refused.index for refused in self._refused)
            raise UserError("\n".join(sorted({refused.reason for refused in self._refused})))


@contextmanager
def _slots(
    engine: str, setup: Setup, workers: int, gpus: tuple[str, ...] | None
) -> Iterator[Sequence[Child]]:
    """The slots of an engine; each of this machine's has one of `gpus` in turn, or all."""
    if engine == "local":
        settings = [] if gpus is None else [{"CUDA_VISIBLE_DEVICES": name} for name in gpus or ("",)]
        environments = islice(cycle(settings or [{}]), workers)
        yield [
            Child(replace(setup, environment={**setup.environment, **variables}))
            for variables in environments
        ]
        return
    from synth.engine import dask

    with dask.open_slots(engine, setup) as slots:
        yield slots
