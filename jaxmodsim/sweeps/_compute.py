"""The runs of a block, computed: in groups that fit the cache, slow runs apart."""

import hashlib
import re
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from ._run import AbstractRun, RunOutcome, out_of_steps, rehearsed

# Runs computed as one on a CPU, and groups of them in one call of compiled code. Measured on two cores with an L1
# cache of 32 kB, for LuGre's test bench, the belt oscillator by events and the double pendulum, in float32 and float64:
# from 32 to 128 runs cost the same within a quarter, 16 and 256 up to twice as much; a call of less than 500 runs
# pays up to a tenth for its start.
GROUP, GROUPS = 64, 16
# Runs of a group of those that take many more steps than the others: in narrow ones they hold up few.
_NARROW = 8


class Computed(NamedTuple):
    """What the runs of a block gave, with the runs as first axis; NaN where a run failed."""

    code: np.ndarray
    num_steps: np.ndarray
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class Work:
    """What is the same for all blocks.

    - `run`, `fixed`: what is computed of one run, and what all have in common.
    - `cap`: steps after which a run is taken out of its group and run again among others like it.
    - `group`: runs that are computed as one.
    - `x64`: whether JAX computes in 64 bits.
    """

    run: AbstractRun
    fixed: PyTree
    cap: int | None
    group: int
    x64: bool


def compute(work: Work, numbers: dict[str, np.ndarray], order: np.ndarray, device: object | None = None) -> Computed:
    """Compute the runs of a block on one device.

    **Arguments:**

    - `numbers`: of the runs, by name, with the runs as first axis.
    - `order`: in which runs are put into groups: neighbours should take equally many steps.
    """
    # The setting is one of the thread, and this may be another one.
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
    """Runs of one call of compiled code in blocks of so many runs."""
    return _groups_of(runs, group) * group


def _groups_of(runs: int, group: int) -> int:
    """Groups in one call: no more than there are, in powers of two so that few shapes are compiled."""
    return min(GROUPS, 1 << max(-(-runs // group) - 1, 0).bit_length()) if group == GROUP else 1


def _in_groups(
    run: AbstractRun,
    fixed: PyTree,
    numbers: dict[str, np.ndarray],
    chosen: np.ndarray,
    shape: tuple[int, int],
    device: object | None,
) -> Computed:
    """Compute the chosen runs, in calls of compiled code for `shape` groups and runs each; the others stay empty."""
    runs, size = next(iter(numbers.values())).shape[0], shape[0] * shape[1]
    computed: Computed | None = None
    for start in range(0, chosen.size, size):
        rows = chosen[start : start + size]
        # The last call is filled up by its last run.
        full = np.concatenate([rows, np.repeat(rows[-1:], size - rows.size)])
        given = {name: x[full].reshape(*shape, *x.shape[1:]) for name, x in numbers.items()}
        given = given if device is None else jax.device_put(given, device)
        part = _answer(run, fixed, given)
        code, steps, values = (jtu.tree_map(_flat, x) for x in (part.code, part.num_steps, part.values))
        if computed is None:
            empty = partial(jtu.tree_map, lambda x: np.zeros((runs, *x.shape[1:]), x.dtype))
            computed = Computed(np.zeros(runs, np.int32), np.zeros(runs, np.int32), empty(values))
        computed.code[rows], computed.num_steps[rows] = code[: rows.size], steps[: rows.size]
        for name, x in values.items():
            computed.values[name][rows] = x[: rows.size]
    assert computed is not None
    return computed


def _answer(run: AbstractRun, fixed: PyTree, given: PyTree) -> RunOutcome:
    """What compiled code gives, when it is there."""
    try:
        return jax.block_until_ready(_call(run, fixed, given))
    except jax.errors.JaxRuntimeError as error:
        match = re.search(r"_EquinoxRuntimeError: (.*)", str(error))
        if match is None:
            raise
        raise RuntimeError(
            f"One of the runs raised an error, which ends all of them: {match[1]} Pass throw=False to simulate in the"
            " function that is swept, and return the run or what is known of it: a run that fails then stays alone."
        ) from error


def _flat(x: Array) -> np.ndarray:
    return np.asarray(x).reshape(-1, *x.shape[2:])


@partial(jax.jit, static_argnames=("run",))
def _call(run: AbstractRun, fixed: PyTree, numbers: dict[str, Array]) -> RunOutcome:
    """Groups one after another, each under `vmap`; numbers have the shape `[groups, runs, ...]`."""
    return jax.lax.map(lambda group: jax.vmap(partial(run.evaluate, fixed))(group), numbers)


def shapes(run: AbstractRun, fixed: PyTree, numbers: PyTree) -> RunOutcome:
    """Shapes and types of what a run gives, traced but not run."""
    return _shapes(rehearsed(run), *_abstract(fixed, numbers))


def program(run: AbstractRun, fixed: PyTree, numbers: PyTree) -> str:
    """A checksum of what is computed, in the language that XLA compiles: the same if and only if that is.

    But for the step limit, which is that of `rehearsed`.
    """
    return _program(rehearsed(run), *_abstract(fixed, numbers))


_Avals: TypeAlias = tuple[tuple[tuple[int, ...], object], ...]


def _abstract(*given: PyTree) -> tuple[object, _Avals]:
    """Structure, shapes and types: all that a trace depends on."""
    leaves, structure = jtu.tree_flatten(given)
    return structure, tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)


def _concrete(structure: object, avals: _Avals) -> PyTree:
    return jtu.tree_unflatten(structure, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in avals])


@lru_cache(maxsize=32)
def _shapes(run: AbstractRun, structure: object, avals: _Avals) -> RunOutcome:
    return jax.eval_shape(run.evaluate, *_concrete(structure, avals))


@lru_cache(maxsize=32)
def _program(run: AbstractRun, structure: object, avals: _Avals) -> str:
    text = jax.jit(run.evaluate).lower(*_concrete(structure, avals)).as_text()
    return hashlib.sha256(text.encode()).hexdigest()
