"""Checks of traced functions of the user: indices out of range, and step functions of time."""

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import GatherScatterMode
from jaxtyping import ArrayLike, PyTree

from .arrays import is_known
from .compat import AVAILABLE, ClosedJaxpr, Jaxpr, JaxprEqn, Literal, scan_counts
from .user_errors import explain

_LOG = logging.getLogger("jaxmodsim")

# Knowledge about a variable while tracing: its integer or boolean value, the name of an argument, or None.
_Known: TypeAlias = np.ndarray | str | None

# Primitives that call one function with their own arguments.
_CALLS = {"jit", "pjit", "closed_call", "core_call", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call"}


def traced(fn: Callable[..., object], *, name: str, **args: object) -> PyTree:
    """Shapes and types of the results of a function, from one trace that also checks its indices and step functions.

    JAX silently clips an index out of range. The check covers indices that are known while tracing: numbers, and arrays
    of numbers. It ignores indices that are computed from the arguments, slices (which Python clips, too), and indices
    with a rule for values out of range (`mode="clip"`, `mode="fill"` with a value).

    **Arguments:**

    - `fn`: the function; the call is `fn(*args.values())`.
    - `name`: name of the function in messages.
    - `args`: its arguments, pytrees of arrays, by their names in messages.

    **Returns:**

    A pytree of `jax.ShapeDtypeStruct`.

    **Raises:**

    - `ValueError` with the function, the index and its array if an index is out of range; or with the line that JAX
      cannot trace and the remedy.
    """
    try:
        jaxpr, shapes = jax.make_jaxpr(fn, return_shape=True)(*args.values())
    except (TypeError, KeyError, IndexError) as error:
        message = explain(error, name, args)
        if message is None:
            raise
        raise ValueError(message) from error
    if "jaxprs" in AVAILABLE:
        names = [key + jtu.keystr(path) for key, arg in args.items() for path, _ in jtu.tree_flatten_with_path(arg)[0]]
        _follow(jaxpr, names, name)
        _warn_about_steps(jaxpr, names, name)
    return shapes


def check_indices(fn: Callable[..., object], *args: object, name: str) -> None:
    """Check the indices of a function as `traced` does; a function that JAX cannot trace passes.

    **Raises:**

    - `ValueError` if an index is out of range.
    """
    if "jaxprs" not in AVAILABLE:
        return
    try:
        jaxpr = jax.make_jaxpr(fn)(*args)
    except Exception:  # the subsequent call raises the same error
        return
    _follow(jaxpr, [None] * len(jaxpr.in_avals), name)


@dataclass(frozen=True)
class _Access:
    """Known indices at which an array is read or written.

    - `shape`: shape of the array.
    - `axes`: indexed axes, `[k]`.
    - `starts`: indices, shape `[n, k]`; negative ones are already increased by the length of the axis.
    - `sizes`: number of entries from each index on, `[k]`.
    - `optional`: whether the operation drops entries out of range. This is legal unless it drops all.
    """

    shape: tuple[int, ...]
    axes: tuple[int, ...]
    starts: np.ndarray
    sizes: tuple[int, ...]
    optional: bool = False

    def beyond(self) -> tuple[int, int] | None:
        """Axis and index, as in the source, of the first one out of range; None if all are in range."""
        length = np.array([self.shape[axis] for axis in self.axes], int)
        last = self.starts + np.array(self.sizes, int) - 1
        out = (self.starts < 0) | (last >= length)
        if not out.any() or (self.optional and not out.any(axis=1).all()):
            return None
        row, k = np.argwhere(out)[0]
        index = self.starts[row, k] - length[k] if self.starts[row, k] < 0 else last[row, k]
        return self.axes[k], int(index)


def _index_message(array: _Known, shape: tuple[int, ...], axis: int, index: int) -> str:
    last = shape[axis] - 1
    if isinstance(array, str) and array in ("q", "qd"):
        many = "1 coordinate" if last == 0 else f"{last + 1} coordinates"
        return (
            f"{array}[{index}] is out of range: there {'is' if last == 0 else 'are'} {many}, so the last is"
            f" {array}[{last}]. Correct the index, or give q0 and qd0 an entry for each coordinate."
        )
    owner = array if isinstance(array, str) else "an array"
    return (
        f"the index {index} is out of range along axis {axis} of {owner} of shape {shape}; the last index is {last}."
        " Correct the index: JAX would silently read another entry, or not write at all."
    )


def _follow(closed: ClosedJaxpr | Jaxpr, inputs: Sequence[_Known], name: str) -> list[_Known]:
    """Propagate knowledge from the inputs of a traced function to its results.

    **Raises:**

    - `ValueError` with `name` if the function reads or writes at an index out of range.
    """
    jaxpr, consts = (closed.jaxpr, closed.consts) if isinstance(closed, ClosedJaxpr) else (closed, ())
    known: dict[object, _Known] = dict(zip(jaxpr.invars, inputs, strict=True))
    known.update(zip(jaxpr.constvars, map(_constant, consts), strict=False))

    def read(x: object) -> _Known:
        return _constant(x.val) if isinstance(x, Literal) else known.get(x)

    for eqn in jaxpr.eqns:
        operands, kind = [read(x) for x in eqn.invars], eqn.primitive.name
        access = _access(eqn, operands)
        beyond = None if access is None else access.beyond()
        if access is not None and beyond is not None:
            raise ValueError(f"In {name}, {_index_message(operands[0], access.shape, *beyond)}")
        results: list[_Known] = []
        for body, body_inputs in _bodies(eqn, operands):
            results = _follow(body, body_inputs, name)
        if kind in _INTEGERS and all(isinstance(x, np.ndarray) for x in operands):
            aval: Any = eqn.outvars[0].aval
            results = [np.asarray(_INTEGERS[kind](*operands, **eqn.params)).astype(aval.dtype)]
        elif kind not in _CALLS:
            results = []
        known.update(zip(eqn.outvars, results, strict=False))
    return [read(x) for x in jaxpr.outvars]


def _constant(value: object) -> np.ndarray | None:
    """The value of integers and booleans; None for tracers and other types."""
    if not is_known(value):
        return None
    kind = np.dtype(int) if isinstance(value, int) else getattr(value, "dtype", None)
    return np.asarray(value) if isinstance(kind, np.dtype) and kind.kind in "iub" else None


def _functions_in(eqn: JaxprEqn) -> list[ClosedJaxpr | Jaxpr]:
    """Functions inside an equation."""
    values = [x for value in eqn.params.values() for x in (value if isinstance(value, tuple | list) else (value,))]
    return [x for x in values if isinstance(x, ClosedJaxpr | Jaxpr)]


def _bodies(eqn: JaxprEqn, operands: list[_Known]) -> list[tuple[ClosedJaxpr | Jaxpr, list[_Known]]]:
    """Functions inside an equation, with knowledge about their inputs; in loops only about constants."""
    bodies, kind, same = _functions_in(eqn), eqn.primitive.name, 0
    if kind in _CALLS:
        same = len(operands)
    elif kind == "scan":
        same, _ = scan_counts(eqn.params)
    elif kind == "cond":
        which, *operands = operands
        same = len(operands)
        if isinstance(which, np.ndarray):
            bodies = [bodies[int(np.clip(which, 0, len(bodies) - 1))]]
    inputs = [len(getattr(body, "jaxpr", body).invars) for body in bodies]
    return [
        (body, operands[: min(same, n)] + [None] * (n - min(same, n))) for body, n in zip(bodies, inputs, strict=True)
    ]


def _access(eqn: JaxprEqn, operands: list[_Known]) -> _Access | None:
    """Indices that an equation reads or writes; None if they are unknown, or may legally be out of range."""
    kind, params = eqn.primitive.name, eqn.params
    if not (kind.startswith("scatter") or kind in ("dynamic_slice", "dynamic_update_slice", "gather")):
        return None
    avals: list[Any] = [x.aval for x in eqn.invars]
    shape = avals[0].shape
    if kind.startswith("dynamic"):
        starts, sizes = operands[1:], params.get("slice_sizes")
        if sizes is None:
            starts, sizes = operands[2:], avals[1].shape
        axes = [i for i, x in enumerate(starts) if isinstance(x, np.ndarray)]
        values = np.array([[starts[i] for i in axes]], int).reshape(1, len(axes))
        return _Access(shape, tuple(axes), values, tuple(sizes[i] for i in axes))
    starts, mode, numbers = operands[1], params["mode"], params["dimension_numbers"]
    if not isinstance(starts, np.ndarray):
        return None
    if kind == "gather":
        axes, dropped, sizes = numbers.start_index_map, numbers.collapsed_slice_dims, params["slice_sizes"]
        fill = params["fill_value"]
        if fill is not None and not np.isnan(fill):
            return None
    else:
        axes, dropped = numbers.scatter_dims_to_operand_dims, numbers.inserted_window_dims
        window = iter([avals[2].shape[i] for i in numbers.update_window_dims])
        single = {*dropped, *numbers.operand_batching_dims}
        sizes = [1 if i in single else next(window) for i in range(len(shape))]
    # With the mode "clip", indexing by jnp drops the axis. If the axis remains, it is a `dynamic_slice` under vmap.
    if mode == GatherScatterMode.CLIP and dropped:
        return None
    rows = starts.reshape(-1, starts.shape[-1])
    return _Access(
        shape, tuple(map(int, axes)), rows, tuple(sizes[i] for i in axes), mode == GatherScatterMode.FILL_OR_DROP
    )


def _broadcast(
    x: np.ndarray, *, shape: tuple[int, ...], broadcast_dimensions: tuple[int, ...], **_: object
) -> np.ndarray:
    sizes = [1] * len(shape)
    for axis, size in zip(broadcast_dimensions, x.shape, strict=True):
        sizes[axis] = size
    return np.broadcast_to(x.reshape(sizes), shape)


def _iota(*, shape: tuple[int, ...], dimension: int, **_: object) -> np.ndarray:
    return np.broadcast_to(
        np.arange(shape[dimension]).reshape([-1 if i == dimension else 1 for i in range(len(shape))]), shape
    )


def _elementwise(fn: Callable[..., ArrayLike]) -> Callable[..., ArrayLike]:
    return lambda *values, **_: fn(*values)


# Primitives of index arithmetic, evaluated by NumPy because JAX would compile each of them.
_INTEGERS: dict[str, Callable[..., ArrayLike]] = {
    **{
        kind: _elementwise(fn)
        for kind, fn in {
            "add": np.add,
            "sub": np.subtract,
            "mul": np.multiply,
            "neg": np.negative,
            "rem": np.fmod,
            "max": np.maximum,
            "min": np.minimum,
            "lt": np.less,
            "le": np.less_equal,
            "gt": np.greater,
            "ge": np.greater_equal,
            "eq": np.equal,
            "ne": np.not_equal,
            "and": np.bitwise_and,
            "or": np.bitwise_or,
            "not": np.invert,
            "select_n": lambda which, *cases: np.choose(which.astype(int), cases),
            "convert_element_type": lambda x: x,
        }.items()
    },
    "broadcast_in_dim": _broadcast,
    "iota": _iota,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, *, dimensions, **_: np.squeeze(x, tuple(dimensions)),
    "stack": lambda *values, axis, **_: np.stack(values, axis),
    "concatenate": lambda *values, dimension, **_: np.concatenate(values, dimension),
}


# Primitives with a value that jumps.
_JUMPS = {"lt", "le", "gt", "ge", "sign", "floor", "ceil", "round"}
# Functions of jax.numpy that compare their arguments, and are continuous.
_CONTINUOUS = {"clip", "_interp", "interp"}


def _warn_about_steps(closed: ClosedJaxpr, names: Sequence[str], name: str) -> None:
    """Warn once per function that compares the time with numbers of `params`: JAX loses their derivatives.

    **Arguments:**

    - `closed`: the traced function.
    - `names`: names of its arguments, such as "t" and "params['ts']".
    - `name`: name of the function in the message.
    """
    if "t" not in names:
        return
    switching: set[str] = set()
    _sources(closed.jaxpr, [frozenset([x]) for x in names], switching)
    if switching:
        _warn(name, ", ".join(sorted(switching)))


@cache
def _warn(name: str, numbers: str) -> None:
    _LOG.warning(
        "In %s a comparison, such as jnp.where(t > ts, a, b), depends on t and on %s. If the value jumps there, JAX"
        " returns a derivative of zero with respect to the switching time. Make the jump an event:"
        " jaxmodsim.Switch(lambda t, q, qd, p: t - p['ts'], above=a, below=b), or a Signal for a sampled input.",
        name,
        numbers,
    )


def _sources(jaxpr: Jaxpr, inputs: Iterable[frozenset[str]], switching: set[str]) -> list[frozenset[str]]:
    """Arguments on which each result depends; `switching` collects the `params` in comparisons with the time."""
    known: dict[object, frozenset[str]] = dict(zip(jaxpr.invars, inputs, strict=True))

    def of(x: object) -> frozenset[str]:
        return frozenset() if isinstance(x, Literal) else known.get(x, frozenset())

    for eqn in jaxpr.eqns:
        operands = [of(x) for x in eqn.invars]
        everything: frozenset[str] = frozenset().union(*operands)
        numbers = {x for x in everything if x.startswith("params")}
        real = any(jnp.issubdtype(getattr(x.aval, "dtype", bool), jnp.floating) for x in eqn.invars)
        if eqn.primitive.name in _JUMPS and real and "t" in everything:
            switching |= numbers
        results = [everything] * len(eqn.outvars)
        if eqn.params.get("name") not in _CONTINUOUS:
            for function in _functions_in(eqn):
                body = function.jaxpr if isinstance(function, ClosedJaxpr) else function
                same = len(body.invars) == len(operands)
                inner = _sources(body, operands if same else [everything] * len(body.invars), switching)
                results = inner if same and len(inner) == len(results) else results
        known.update(zip(eqn.outvars, results, strict=True))
    return [of(x) for x in jaxpr.outvars]
