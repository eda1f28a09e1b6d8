"""Computes the blocks of a sweep: in groups of runs that fit the cache, on all cores, devices or machines."""

import concurrent.futures as cf
import hashlib
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._core.speed import cores
from .._core.system import extra
from ._run import AbstractRun, RunOutcome, out_of_steps, rehearsed

# Runs in a group on a CPU, and groups in a call of compiled code. Measured on two cores with an L1 cache of 32 kB, for
# LuGre's test bench, the event-driven belt oscillator and the double pendulum, in float32 and float64: the time per run
# is the same within 25 % for groups of 32 to 128 runs, and up to twice that for 16 and 256. A call of less than 500
# runs has an overhead of up to 10 %.
GROUP, GROUPS = 64, 16
# Runs in a group of runs with many more steps than the others; small groups waste fewer steps.
_NARROW = 8
# A block: its index, the numbers of its runs, and the order in which they are computed.
Task = tuple[int, dict[str, np.ndarray], np.ndarray]
# Tasks submitted per worker: one running, one waiting.
_AHEAD = 2
# Assumed number of workers of an executor that does not state it.
_UNKNOWN_WORKERS = 64

# Number of sweeps whose compiled code a process keeps.
_KEPT = 4


class Computed(NamedTuple):
    """The results of a block, with the runs as first axis; NaN for runs that failed."""

    code: np.ndarray
    num_steps: np.ndarray
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class Work:
    """The values common to all blocks.

    - `run`, `fixed`: the computation of one run, and the values common to all runs.
    - `cap`: limit of steps after which a run leaves its group and is computed again with other slow runs.
    - `group`: number of runs that are computed together.
    - `x64`: whether JAX computes in 64 bits.
    """

    run: AbstractRun
    fixed: PyTree
    cap: int | None
    group: int
    x64: bool


_works: dict[str, Work] = {}
_lock = threading.Lock()


def compute(work: Work, numbers: dict[str, np.ndarray], order: np.ndarray, device: object | None = None) -> Computed:
    """Compute the runs of a block on one device.

    **Arguments:**

    - `numbers`: of the runs, by name, with the runs as first axis.
    - `order`: the order in which runs form groups; neighbours should take similar numbers of steps.
    """
    # The setting is local to a thread.
    with jax.enable_x64(work.x64):
        fixed = work.fixed if device is None else jax.device_put(work.fixed, device)
        first = work.run if work.cap is None else work.run.within(work.cap)
        computed = _in_groups(first, fixed, numbers, order, (_groups_of(order.size, work.group), work.group), device)
        slow = np.flatnonzero(out_of_steps(computed.code)) if work.cap is not None else np.zeros(0, int)
        if slow.size:
            shape = (1, _NARROW if work.group == GROUP else work.group)
            again = _in_groups(work.run, fixed, numbers, slow, shape, device)
            for whole, part in zip(jtu.tree_leaves(computed), jtu.tree_leaves(again), strict=True):
                whole[slow] = part[slow]
    failed = computed.code != 0
    for value in computed.values.values():
        value[failed] = np.nan
    return computed


def runs_per_call(runs: int, group: int) -> int:
    """Number of runs in a call of compiled code, for blocks of `runs`."""
    return _groups_of(runs, group) * group


def _groups_of(runs: int, group: int) -> int:
    """Number of groups in a call: a power of two, so that few shapes are compiled."""
    return min(GROUPS, 1 << max(-(-runs // group) - 1, 0).bit_length()) if group == GROUP else 1


def _in_groups(
    run: AbstractRun,
    fixed: PyTree,
    numbers: dict[str, np.ndarray],
    chosen: np.ndarray,
    shape: tuple[int, int],
    device: object | None,
) -> Computed:
    """Compute the chosen runs in calls of compiled code; `shape` is the number of groups and of runs in each."""
    runs, size = next(iter(numbers.values())).shape[0], shape[0] * shape[1]
    computed: Computed | None = None
    for start in range(0, chosen.size, size):
        rows = chosen[start : start + size]
        # The last run fills up the last call.
        full = np.concatenate([rows, np.repeat(rows[-1:], size - rows.size)])
        own = {name: x[full].reshape(*shape, *x.shape[1:]) for name, x in numbers.items()}
        part = _call_and_wait(run, fixed, own if device is None else jax.device_put(own, device))
        flat = partial(jtu.tree_map, lambda x: np.asarray(x).reshape(-1, *x.shape[2:]))
        code, steps, values = flat((part.code, part.num_steps, part.values))
        if computed is None:
            empty = partial(jtu.tree_map, lambda x: np.zeros((runs, *x.shape[1:]), x.dtype))
            computed = Computed(np.zeros(runs, np.int32), np.zeros(runs, np.int32), empty(values))
        computed.code[rows], computed.num_steps[rows] = code[: rows.size], steps[: rows.size]
        for name, x in values.items():
            computed.values[name][rows] = x[: rows.size]
    assert computed is not None
    return computed


def _call_and_wait(run: AbstractRun, fixed: PyTree, numbers: PyTree) -> RunOutcome:
    try:
        return jax.block_until_ready(_call(run, fixed, numbers))
    except jax.errors.JaxRuntimeError as error:
        match = re.search(r"_EquinoxRuntimeError: (.*)", str(error))
        if match is None:
            raise
        raise RuntimeError(
            f"One of the runs raised an error, which ends the sweep: {match[1]} Pass throw=False to simulate in the"
            " swept function, and return the run or numbers of it: a failure then affects this run alone."
        ) from error


@partial(jax.jit, static_argnames=("run",))
def _call(run: AbstractRun, fixed: PyTree, numbers: dict[str, Array]) -> RunOutcome:
    """Groups one after another, each under `vmap`; numbers have the shape `[groups, runs, ...]`."""
    return jax.lax.map(lambda group: jax.vmap(partial(run.evaluate, fixed))(group), numbers)


def shapes(run: AbstractRun, fixed: PyTree, numbers: PyTree) -> RunOutcome:
    """Shapes and types of the results of a run, traced but not computed."""
    return _shapes(rehearsed(run), *_abstract(fixed, numbers))


def program(run: AbstractRun, fixed: PyTree, numbers: PyTree) -> str:
    """A checksum of the program that XLA compiles, with the limit of steps of `rehearsed`."""
    return _program(rehearsed(run), *_abstract(fixed, numbers))


def _abstract(*trees: PyTree) -> tuple[Any, tuple[jax.ShapeDtypeStruct, ...]]:
    """Structure, shapes and types, which determine a trace."""
    leaves, structure = jtu.tree_flatten(trees)
    return structure, tuple(jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in leaves)


@lru_cache(maxsize=32)
def _shapes(run: AbstractRun, structure: Any, leaves: tuple[jax.ShapeDtypeStruct, ...]) -> RunOutcome:
    return jax.eval_shape(run.evaluate, *jtu.tree_unflatten(structure, leaves))


@lru_cache(maxsize=32)
def _program(run: AbstractRun, structure: Any, leaves: tuple[jax.ShapeDtypeStruct, ...]) -> str:
    text = jax.jit(run.evaluate).lower(*jtu.tree_unflatten(structure, leaves)).as_text()
    return hashlib.sha256(text.encode()).hexdigest()


def in_threads(work: Work, tasks: Iterable[Task], devices: list[Any]) -> Iterator[tuple[int, Computed]]:
    """Compute blocks in threads of this process: one per device, or one per core for a single CPU device.

    A compiled loop over small states uses one core, and releases the interpreter lock.
    """
    each = cores() if len(devices) == 1 and devices[0].platform == "cpu" else 1
    # Numbers without an explicit device go to the first one, which is faster.
    explicit = devices != jax.local_devices()[:1]
    slots = [device if explicit else None for device in devices for _ in range(each)]
    free = list(slots)

    def run(task: Task) -> tuple[int, Computed]:
        device = free.pop()
        try:
            return task[0], compute(work, *task[1:], device)
        finally:
            free.append(device)

    pool = cf.ThreadPoolExecutor(len(slots))
    try:
        yield from _as_completed(lambda task: pool.submit(run, task), tasks, _AHEAD * len(slots))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def run_on_executor(work: Work, tasks: Iterable[Task], executor: Any) -> Iterator[tuple[int, Computed]]:
    """Compute blocks on a `concurrent.futures.Executor` or a `dask.distributed.Client`.

    The latter repeats the blocks of a lost worker.
    """
    # By value, including functions of a script or notebook; each process unpickles equal bytes once.
    packed = extra("cloudpickle").dumps(work)
    key = hashlib.sha256(packed).hexdigest()
    if isinstance(executor, cf.Executor):
        opened, workers = nullcontext(executor), getattr(executor, "_max_workers", None)
    elif callable(getattr(executor, "get_executor", None)):
        opened, workers = executor.get_executor(pure=False), sum(executor.nthreads().values())
    else:
        raise ValueError(
            "executor must be a dask.distributed.Client or a concurrent.futures.Executor, but a"
            f" {type(executor).__name__} was given."
        )
    most = _AHEAD * (workers or _UNKNOWN_WORKERS)
    with opened as pool:
        # The work is sent with every block, as scattered data is lost with the last worker that holds it.
        yield from _as_completed(lambda task: pool.submit(run_packed, key, packed, task), tasks, most)


def run_packed(key: str, packed: bytes, task: Task) -> tuple[int, Computed]:
    """Compute a block in another process, which keeps its compiled code."""
    with _lock:
        if key not in _works:
            if len(_works) == _KEPT:
                _works.clear()
            with jax.enable_x64(True):  # else arrays of 64 bits would be truncated
                _works[key] = extra("cloudpickle").loads(packed)
        work = _works[key]
    return task[0], compute(work, *task[1:])


def _as_completed(
    submit: Callable[[Task], cf.Future], tasks: Iterable[Task], most: int
) -> Iterator[tuple[int, Computed]]:
    """Results in order of completion; at most `most` tasks are submitted, and in memory, at a time."""
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
