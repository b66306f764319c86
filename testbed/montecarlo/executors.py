"""Where the units of a Monte Carlo are computed: in this process, in a pool of processes, or on a Dask cluster.

The pool and the cluster go through `concurrent.futures.Executor`. A worker that dies or hangs costs at most the units
in flight, which are computed again; a unit that keeps killing its worker is given up for the estimator that did it.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import tempfile
import time
import types
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from testbed.base.child_processes import can_fork, end_with_parent, quietly
from testbed.base.errors import InputError, MissingExtra, TestbedError
from testbed.base.time_limit import single_threaded, thread_environment
from testbed.data.registry import estimator_class
from testbed.montecarlo.store import encode
from testbed.montecarlo.work_unit import BLOCK, Bench, Setup, UnitResult, goes_side_by_side, lost

POLL_S = 0.25
GRACE_S = 5.0
"""How long after its time limit an estimator may take to notice, before its worker is killed."""
ATTEMPTS = 2
"""A unit that was in flight when so many pools broke is computed alone from then on, to find out whether it is to blame."""


@dataclass(frozen=True)
class Finished:
    """A unit that is done: the bytes of its file, and those of ``details`` (run 0)."""

    run: int
    content: bytes
    files: dict[str, bytes] = field(default_factory=dict)


def pack(setup: Setup, result: UnitResult) -> Finished:
    """A unit's result as it travels."""
    return Finished(result.run, encode(result, setup.batch), result.files)


Block = tuple[int, ...]
"""The runs of a unit."""


def blocks_of(setup: Setup, runs: Sequence[int], workers: int) -> list[Block]:
    """Units of neighbouring runs: as large as may be, and yet so that every worker has one, where anybody filters several at
    once; of one run each else."""
    size = max(1, min(BLOCK, math.ceil(len(runs) / max(1, workers)))) if _any_side_by_side(setup) else 1
    return [tuple(runs[k : k + size]) for k in range(0, len(runs), size)]


def _any_side_by_side(setup: Setup) -> bool:
    scenario = setup.scenario
    kinds = [estimator_class(entry.name) for entry in scenario.estimators]
    return scenario.monte_carlo.side_by_side and any(goes_side_by_side(kind) for kind in kinds)


def inline(setup: Setup, runs: Sequence[int]) -> Iterator[Finished]:
    """Compute the units in this process, one after the other."""
    with single_threaded():
        bench = Bench(setup)
        for block in blocks_of(setup, runs, 1):
            yield from (pack(setup, result) for result in bench.execute_block(block))


_bench: Bench | None = None
_heartbeats: Path | None = None
_standing = ExitStack()


def _start_worker(setup: Setup, heartbeats: str) -> None:
    """Runs once in each process of the pool."""
    global _bench, _heartbeats
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's business
    end_with_parent()
    _standing.enter_context(single_threaded())
    _bench, _heartbeats = Bench(setup), Path(heartbeats)
    _beat((), "", None)


def _beat(runs: Sequence[int], estimator: str, limit: float | None) -> None:
    """Leave word of what this process begins and when it should be done."""
    assert _heartbeats is not None
    deadline = time.monotonic() + limit if limit is not None else math.inf
    text = f"{' '.join(map(str, runs))}\n{deadline!r}\n{estimator}"
    (_heartbeats / str(os.getpid())).write_text(text)


def _work(block: Block, skip: dict[int, dict[str, str]]) -> list[Finished]:
    assert _bench is not None
    return [pack(_bench.setup, result) for result in _bench.execute_block(block, skip, _beat)]


class Pool:
    """A pool of ``jobs`` processes that survives the death of its workers."""

    def __init__(self, setup: Setup, jobs: int) -> None:
        self.setup, self.jobs = setup, jobs
        self.limit = setup.limit_s
        self._folder = tempfile.TemporaryDirectory(prefix="testbed-")
        self._executor: ProcessPoolExecutor | None = None
        self._broken: dict[int, int] = {}
        self._failed_starts = 0
        self._skip: dict[int, dict[str, str]] = {}

    def run(self, runs: Sequence[int]) -> Iterator[Finished]:
        """Runs in the order in which they are done; two units per worker are in flight, the first from now on."""
        units = self._units(iter(blocks_of(self.setup, runs, self.jobs)))
        next(units)
        return units  # type: ignore[return-value]  # only the first, which is taken, is None

    def _units(self, waiting: Iterator[Block]) -> Iterator[Finished | None]:
        """None once the first units are in flight, so that closing the generator ends the workers even then; the runs."""
        flying: dict[Future[list[Finished]], Block] = {}
        again: list[int] = []
        try:
            flying |= {self._submit(block): block for block in islice(waiting, 2 * self.jobs)}
            yield None
            while True:
                while len(flying) < 2 * self.jobs and (block := next(waiting, None)) is not None:
                    flying[self._submit(block)] = block
                if not flying:
                    break
                done, _ = wait(flying, timeout=POLL_S, return_when=FIRST_COMPLETED)
                if self.limit:
                    self._kill_hanging(self.limit)
                for future in done:
                    block = flying.pop(future)
                    try:
                        done_runs = future.result()
                    except BrokenProcessPool:
                        again += block
                    else:
                        self._failed_starts = 0
                        yield from done_runs
                if again:
                    again += [run for block in flying.values() for run in block]
                    flying.clear()
                    self._shutdown()
                    alone = self._suspects(again)
                    for run in alone:
                        yield self._alone(run)
                    for run in sorted(set(again) - set(alone)):
                        flying[self._submit((run,))] = (run,)
                    again = []
        finally:
            self._shutdown()
            self._folder.cleanup()

    def _submit(self, block: Block) -> Future[list[Finished]]:
        if self._executor is None:
            self._executor = self._start(self.jobs)
        with thread_environment(), _without_main(), quietly():
            try:
                return self._executor.submit(_work, block, {run: self._skip[run] for run in block if run in self._skip})
            except BrokenProcessPool as error:
                failed: Future[list[Finished]] = Future()
                failed.set_exception(error)
                return failed

    def _start(self, jobs: int) -> ProcessPoolExecutor:
        """Workers that begin as copies of this process where that is safe, else with an interpreter of their own."""
        context = get_context("fork" if can_fork() else "spawn")
        return ProcessPoolExecutor(jobs, context, _start_worker, (self.setup, self._folder.name))

    def _kill_hanging(self, limit: float) -> None:
        """Kill workers whose estimator does not heed its time limit, and give that estimator up for the run."""
        for pid, block, deadline, estimator in self._heartbeats():
            if estimator and time.monotonic() > deadline + GRACE_S:
                if len(block) == 1:  # of several, each is tried by itself next
                    told = f"timeout: no answer within {limit:g} s, worker killed"
                    self._skip.setdefault(block[0], {})[estimator] = told
                    self._broken[block[0]] = 0
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                (Path(self._folder.name) / str(pid)).write_text("\n0\n")

    def _heartbeats(self) -> list[tuple[int, Block, float, str]]:
        """(process, runs, deadline, estimator) of what each worker last began; an empty estimator means nothing."""
        out = []
        for path in Path(self._folder.name).iterdir():
            lines = path.read_text().split("\n", 2)
            if len(lines) == 3:
                out.append((int(path.name), tuple(map(int, lines[0].split())), float(lines[1]), lines[2]))
        return out

    def _suspects(self, lost: list[int]) -> list[int]:
        """Runs that were being computed in more than `ATTEMPTS` pools that broke."""
        heartbeats = self._heartbeats()
        active = {run for _, block, _, estimator in heartbeats if estimator and len(block) == 1 for run in block}
        for path in Path(self._folder.name).iterdir():
            path.unlink()
        for run in active & set(lost):
            self._broken[run] = self._broken.get(run, 0) + 1
        if not heartbeats:
            self._failed_starts += 1
            if self._failed_starts > ATTEMPTS:
                raise TestbedError(
                    "the worker processes die when they start; see their messages above, or use --jobs 1"
                )
        return [run for run in sorted(set(lost)) if self._broken.get(run, 0) >= ATTEMPTS]

    def _alone(self, run: int) -> Finished:
        """Compute a suspected unit in a pool of its own; whichever estimator kills the worker then is the culprit."""
        for _ in range(len(self.setup.scenario.estimators) + 2):
            self._executor = self._start(1)
            try:
                future = self._submit((run,))
                while not wait([future], timeout=POLL_S).done:
                    if self.limit:
                        self._kill_hanging(self.limit)
                return future.result()[0]
            except BrokenProcessPool:
                for _, active, _, estimator in self._heartbeats():
                    if active == (run,) and estimator:
                        self._skip.setdefault(run, {})[estimator] = (
                            "failed: it ended its worker process (crash or memory)"
                        )
            finally:
                self._shutdown()
                for path in Path(self._folder.name).iterdir():
                    path.unlink()
        raise TestbedError(f"run {run} ends every worker that computes it")

    def _shutdown(self) -> None:
        """End the workers at once; what they were doing is lost."""
        executor, self._executor = self._executor, None
        if executor is None:
            return
        processes = list((executor._processes or {}).values())
        for process in processes:
            process.kill()
        executor.shutdown(wait=True, cancel_futures=True)
        for process in processes:
            process.join()


@contextlib.contextmanager
def _without_main() -> Iterator[None]:
    """Spawned workers import the caller's script again, unless it is hidden: a script needs no ``if __name__`` guard."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


_cluster_benches: dict[tuple[str, tuple[str, ...], float | None], Bench] = {}


def cluster_work(setup: Setup, block: Block) -> list[Finished]:
    """A unit on a worker that may never have heard of this batch; its bench stays for the next unit."""
    key = (setup.scenario.digest(), setup.plugins, setup.timeout_s)
    if key not in _cluster_benches:
        _cluster_benches.clear()
        _standing.enter_context(single_threaded())
        _cluster_benches[key] = Bench(setup)
    return [pack(setup, result) for result in _cluster_benches[key].execute_block(block)]


def connect(address: str) -> Any:
    """A client, to be closed, of the Dask cluster whose scheduler listens at ``address``.

    Raises InputError without the extra ``cluster``, or where no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtra("--scheduler needs the extra 'cluster': pip install 'navigation-testbed[cluster]'") from None
    try:
        return Client(address, timeout=10)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address} ({error})") from None


def cluster(setup: Setup, runs: Sequence[int], client: Any) -> Iterator[Finished]:
    """Compute the units on the Dask cluster of ``client``, two per thread in flight."""
    from concurrent.futures import CancelledError

    from distributed.comm import CommClosedError
    from distributed.scheduler import KilledWorker

    executor = client.get_executor(pure=False)
    waiting = iter(blocks_of(setup, runs, sum(client.nthreads().values())))
    flying: dict[Future[list[Finished]], Block] = {}
    while True:
        wanted = 2 * max(1, sum(client.nthreads().values()))
        while len(flying) < wanted and (block := next(waiting, None)) is not None:
            flying[executor.submit(cluster_work, setup, block)] = block
        if not flying:
            return
        done, _ = wait(flying, return_when=FIRST_COMPLETED)
        for future in done:
            block = flying.pop(future)
            try:
                yield from future.result()
            except KilledWorker:
                if len(block) > 1:  # find out which of them it is
                    flying |= {executor.submit(cluster_work, setup, (run,)): (run,) for run in block}
                else:
                    yield pack(setup, lost(setup, block[0], "it ended every Dask worker that computed it"))
            except (CancelledError, CommClosedError) as error:
                raise TestbedError("the Dask cluster is gone; run the same command with --resume") from error
