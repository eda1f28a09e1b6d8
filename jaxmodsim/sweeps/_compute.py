"""The lanes of a block, computed: in groups that fit the cache, slow lanes apart."""

import hashlib
import re
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from ._lane import AbstractLane, Found, out_of_steps, rehearsed

# Lanes that are run as one on a CPU, and groups of them in one call of compiled code. Measured on two cores with an L1
# cache of 32 kB, for LuGre's test bench, the belt oscillator by events and the double pendulum, in float32 and float64:
# from 32 to 128 lanes cost the same within a quarter, 16 and 256 up to twice as much; a call of less than 500 lanes
# pays up to a tenth for its start.
GROUP, GROUPS = 64, 16
# Lanes of a group of those that take many more steps than the others: in narrow ones they hold up few.
_NARROW = 8


class Computed(NamedTuple):
    """What the lanes of a block gave, with the lanes as first axis; NaN where a lane failed."""

    code: np.ndarray
    num_steps: np.ndarray
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class Work:
    """What is the same for all blocks.

    - `lane`, `fixed`: what is computed.
    - `cap`: steps after which a lane is taken out of its group and run again among others like it.
    - `group`: lanes that are run as one.
    - `x64`: whether JAX computes in 64 bits.
    """

    lane: AbstractLane
    fixed: PyTree
    cap: int | None
    group: int
    x64: bool


def compute(work: Work, numbers: dict[str, np.ndarray], order: np.ndarray, device: Any | None = None) -> Computed:
    """Compute the lanes of a block on one device.

    **Arguments:**

    - `numbers`: of the lanes, by name, with the lanes as first axis.
    - `order`: in which lanes are put into groups: neighbours should take equally many steps.
    """
    # The setting is one of the thread, and this may be another one.
    with jax.enable_x64(work.x64):
        fixed = work.fixed if device is None else jax.device_put(work.fixed, device)
        first = work.lane if work.cap is None else work.lane.within(work.cap)
        found = _in_groups(first, fixed, numbers, order, (_groups_of(order.size, work.group), work.group), device)
        slow = np.flatnonzero(out_of_steps(found.code)) if work.cap is not None else np.zeros(0, int)
        if slow.size:
            shape = (1, _NARROW if work.group == GROUP else work.group)
            again = _in_groups(work.lane, fixed, numbers, slow, shape, device)
            for whole, part in zip(jtu.tree_leaves(found), jtu.tree_leaves(again), strict=True):
                whole[slow] = part[slow]
    failed = found.code != 0
    for value in found.values.values():
        value[failed] = np.nan
    return found


def lanes_of_call(lanes: int, group: int) -> int:
    """Lanes of one call of compiled code in blocks of so many lanes."""
    return _groups_of(lanes, group) * group


def _groups_of(lanes: int, group: int) -> int:
    """Groups in one call: no more than there are, in powers of two so that few shapes are compiled."""
    return min(GROUPS, 1 << max(-(-lanes // group) - 1, 0).bit_length()) if group == GROUP else 1


def _in_groups(
    lane: AbstractLane,
    fixed: PyTree,
    numbers: dict[str, np.ndarray],
    chosen: np.ndarray,
    shape: tuple[int, int],
    device: Any | None,
) -> Computed:
    """Compute the chosen lanes, in calls of compiled code for `shape` groups and lanes each; the others stay empty."""
    lanes, size = next(iter(numbers.values())).shape[0], shape[0] * shape[1]
    found: Computed | None = None
    for start in range(0, chosen.size, size):
        rows = chosen[start : start + size]
        # The last call is filled up by its last lane.
        full = np.concatenate([rows, np.repeat(rows[-1:], size - rows.size)])
        given = {name: x[full].reshape(*shape, *x.shape[1:]) for name, x in numbers.items()}
        given = given if device is None else jax.device_put(given, device)
        part = _answer(lane, fixed, given)
        code, steps, values = (jtu.tree_map(_flat, x) for x in (part.code, part.num_steps, part.values))
        if found is None:
            empty = partial(jtu.tree_map, lambda x: np.zeros((lanes, *x.shape[1:]), x.dtype))
            found = Computed(np.zeros(lanes, np.int32), np.zeros(lanes, np.int32), empty(values))
        found.code[rows], found.num_steps[rows] = code[: rows.size], steps[: rows.size]
        for name, x in values.items():
            found.values[name][rows] = x[: rows.size]
    assert found is not None
    return found


def _answer(lane: AbstractLane, fixed: PyTree, given: dict[str, Any]) -> Found:
    """What compiled code gives, when it is there."""
    try:
        return jax.block_until_ready(_call(lane, fixed, given))
    except jax.errors.JaxRuntimeError as error:
        found = re.search(r"_EquinoxRuntimeError: (.*)", str(error))
        if found is None:
            raise
        raise RuntimeError(
            f"One of the lanes raised an error, which ends all of them: {found[1]} Pass throw=False to simulate in the"
            " function that is swept, and return the run or what is known of it: a lane that fails then stays alone."
        ) from error


def _flat(x: Array) -> np.ndarray:
    return np.asarray(x).reshape(-1, *x.shape[2:])


@partial(jax.jit, static_argnames=("lane",))
def _call(lane: AbstractLane, fixed: PyTree, numbers: dict[str, Array]) -> Found:
    """Groups one after another, each under `vmap`; numbers have the shape `[groups, lanes, ...]`."""
    return jax.lax.map(lambda group: jax.vmap(partial(lane.run, fixed))(group), numbers)


def shapes(lane: AbstractLane, fixed: PyTree, numbers: PyTree) -> Found:
    """Shapes and types of what a lane gives, traced but not run."""
    return _shapes(rehearsed(lane), *_abstract(fixed, numbers))


def program(lane: AbstractLane, fixed: PyTree, numbers: PyTree) -> str:
    """A checksum of what is computed, in the language that XLA compiles: the same if and only if that is.

    But for the step limit, which is that of `rehearsed`.
    """
    return _program(rehearsed(lane), *_abstract(fixed, numbers))


_Abstract: TypeAlias = tuple[Any, tuple[tuple[tuple[int, ...], Any], ...]]


def _abstract(*given: PyTree) -> _Abstract:
    """Structure, shapes and types: all that a trace depends on."""
    leaves, structure = jtu.tree_flatten(given)
    return structure, tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)


def _concrete(structure: Any, avals: Any) -> Any:
    return jtu.tree_unflatten(structure, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in avals])


@lru_cache(maxsize=32)
def _shapes(lane: AbstractLane, structure: Any, avals: Any) -> Found:
    return jax.eval_shape(lane.run, *_concrete(structure, avals))


@lru_cache(maxsize=32)
def _program(lane: AbstractLane, structure: Any, avals: Any) -> str:
    text = jax.jit(lane.run).lower(*_concrete(structure, avals)).as_text()
    return hashlib.sha256(text.encode()).hexdigest()
