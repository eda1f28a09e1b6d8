"""Blocks handed out: to threads of this process, or to an executor that runs them elsewhere."""

import concurrent.futures as cf
import hashlib
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any

import jax
import numpy as np

from .._core.speed import cores
from .._core.system import extra
from ._compute import Computed, Work, compute

# A block: its number, the numbers of its runs, and the order in which they are run.
Task = tuple[int, dict[str, np.ndarray], np.ndarray]
# Tasks handed out for each worker: one at work, one waiting.
_AHEAD = 2
# Workers of a cluster may come and go: as many as one would hardly have.
_UNKNOWN_WORKERS = 64

# Sweeps whose compiled code a process keeps.
_KEPT = 4

_works: dict[str, Work] = {}
_lock = threading.Lock()


def in_threads(work: Work, tasks: Iterable[Task], devices: list[Any]) -> Iterator[tuple[int, Computed]]:
    """Run blocks in threads of this process: one for each device, or for each core where there is one CPU device.

    A compiled loop over small states uses one core, and lets other threads run.
    """
    each = cores() if len(devices) == 1 and devices[0].platform == "cpu" else 1
    # Numbers that are not sent anywhere go to the first device, which is cheaper.
    sent = devices != jax.local_devices()[:1]
    places = [device if sent else None for device in devices for _ in range(each)]
    free = list(places)

    def run(task: Task) -> tuple[int, Computed]:
        device = free.pop()
        try:
            return task[0], compute(work, *task[1:], device)
        finally:
            free.append(device)

    pool = cf.ThreadPoolExecutor(len(places))
    try:
        yield from _as_completed(lambda task: pool.submit(run, task), tasks, _AHEAD * len(places))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def run_on_executor(work: Work, tasks: Iterable[Task], executor: Any) -> Iterator[tuple[int, Computed]]:
    """Run blocks by a `concurrent.futures.Executor` or a `dask.distributed.Client`.

    The latter runs those of a lost worker again.
    """
    # By value, functions defined in a script or a notebook included; equal bytes are unpickled once in each process.
    packed = extra("cloudpickle").dumps(work)
    key = hashlib.sha256(packed).hexdigest()
    if isinstance(executor, cf.Executor):
        workers = getattr(executor, "_max_workers", None) or _UNKNOWN_WORKERS
        yield from _as_completed(lambda task: executor.submit(run_packed, key, packed, task), tasks, _AHEAD * workers)
        return
    if not callable(getattr(executor, "get_executor", None)):
        raise ValueError(
            "executor must be a dask.distributed.Client or a concurrent.futures.Executor, but a"
            f" {type(executor).__name__} was given."
        )
    # Sent with every block: what is scattered to the workers is gone with the last one that holds it.
    with executor.get_executor(pure=False) as pool:
        workers = sum(executor.nthreads().values()) or _UNKNOWN_WORKERS
        yield from _as_completed(lambda task: pool.submit(run_packed, key, packed, task), tasks, _AHEAD * workers)


def run_packed(key: str, packed: bytes, task: Task) -> tuple[int, Computed]:
    """Run a block in another process, which keeps what it has compiled."""
    with _lock:
        if key not in _works:
            if len(_works) == _KEPT:
                _works.clear()
            # Arrays of 64 bits would lose half of them on the way in.
            _works[key] = _unpacked(packed)
        work = _works[key]
    return task[0], compute(work, *task[1:])


def _unpacked(packed: bytes) -> Work:
    with jax.enable_x64(True):
        return extra("cloudpickle").loads(packed)


def _as_completed(
    submit: Callable[[Task], cf.Future], tasks: Iterable[Task], most: int
) -> Iterator[tuple[int, Computed]]:
    """Results as they come, with so many tasks handed out at once: no more than those are in memory."""
    tasks = iter(tasks)
    waiting = {submit(task) for task in islice(tasks, most)}
    try:
        while waiting:
            done, waiting = cf.wait(waiting, return_when=cf.FIRST_COMPLETED)
            for future in done:
                yield future.result()
            waiting |= {submit(task) for task in islice(tasks, len(done))}
    finally:
        for future in waiting:
            future.cancel()
