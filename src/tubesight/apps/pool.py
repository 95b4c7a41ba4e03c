"""Tasks over the processes of this machine or the workers of a Dask cluster, behind one signature."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import Any, Protocol, TypeVar

import cv2

from tubesight import __version__
from tubesight.core import InputError

Task = TypeVar("Task")
Result = TypeVar("Result")

# A scheduler on the same network answers within milliseconds.
_CONNECT_S = 10


class Pool(Protocol):
    """Somewhere tasks are done."""

    def __call__(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """Yield the index of each task with its result, in the order in which they are done.

        Parameters
        ----------
        function
            Of a module's top level: it is sent to other processes by name.
        """
        ...


def usable_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def open_pool(workers: int, scheduler: str | None = None) -> Iterator[Pool]:
    """Open a pool, and close it with all that it started; after an interruption tasks are left where they are.

    Parameters
    ----------
    workers
        Processes on this machine; with one, tasks are done in this process.
    scheduler
        Address of a Dask scheduler, ``tcp://HOST:8786``, whose workers do the tasks instead.

    Raises
    ------
    InputError
        If the scheduler does not answer, or has no worker with this version of tubesight.
    """
    if scheduler is not None:
        with _cluster(scheduler) as pool:
            yield pool
    elif workers == 1:
        yield _here
    else:
        # Processes are spawned: a fork would copy the locks of OpenCV's and numba's threads.
        context = get_context("spawn")
        theirs, ours = context.Pipe(duplex=False)
        executor = ProcessPoolExecutor(workers, context, _quiet_worker, (theirs,))
        try:
            yield _Processes(executor)
        except BaseException:
            # A task may have minutes to go: its process ends now, not when it is done.
            ours.close()
            raise
        finally:
            executor.shutdown(cancel_futures=True)
            ours.close()
            theirs.close()


def _here(function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
    for index, task in enumerate(tasks):
        yield index, function(task)


def _quiet_worker(parent: Connection) -> None:
    """Leave an interruption to the parent, end with it, and leave the other cores to the other workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with, args=(parent,), daemon=True).start()
    cv2.setNumThreads(1)


def _end_with(parent: Connection) -> None:
    """Wait for the other end to close: by hand, or because its process was killed and cannot tell its workers."""
    wait([parent])
    os._exit(1)


class _Processes:
    def __init__(self, executor: ProcessPoolExecutor) -> None:
        self._executor = executor

    def __call__(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        try:
            futures = {self._executor.submit(function, task): index for index, task in enumerate(tasks)}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise InputError(
                "a worker process was killed, probably for want of memory; go on with --resume and fewer --workers"
            ) from error


@contextmanager
def _cluster(address: str) -> Iterator[Pool]:
    try:
        import distributed
    except ImportError as error:
        raise InputError("--scheduler needs Dask (pip install 'tubesight[cluster]')") from error
    try:
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{address}: no Dask scheduler answers; start `dask scheduler` and name its address, tcp://HOST:8786"
        ) from error
    with client:
        _require_workers(client, address)

        def pool(function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
            # A task whose worker dies is done by another one: Dask sees to that.
            futures = client.map(function, tasks, pure=False)
            index_of = {future.key: index for index, future in enumerate(futures)}
            try:
                for future, result in distributed.as_completed(futures, loop=client.loop, with_results=True):
                    yield index_of[future.key], result
            except distributed.KilledWorker as error:
                raise InputError(
                    f"{address}: a task ended several workers, probably for want of memory; go on with --resume and "
                    "workers that have more"
                ) from error

        yield pool


def _require_workers(client: Any, address: str) -> None:
    versions = client.run(_version)
    if not versions:
        raise InputError(f"{address}: the scheduler has no workers; start `dask worker {address}`")
    for worker, version in versions.items():
        if version != __version__:
            raise InputError(f"{worker}: has tubesight {version}, here is {__version__}; install the same there")


def _version() -> str:
    return __version__
