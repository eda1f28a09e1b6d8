"""Indices out of range in functions of the user, which JAX moves into the range in silence."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.core
import jax.tree_util as jtu
import numpy as np
from jax.lax import GatherScatterMode
from jaxtyping import ArrayLike, PyTree

from .compat import AVAILABLE, ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from .step_functions import remark_on_steps
from .user_errors import explain

# What is known of a variable while tracing: its value, integers or booleans; the name of an argument; nothing.
_Known: TypeAlias = np.ndarray | str | None

# Primitives that call one function with their own arguments.
_CALLS = {"jit", "pjit", "closed_call", "core_call", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call"}


def traced(fn: Callable[..., object], *, name: str, **args: object) -> PyTree:
    """Shapes and types of what a function returns, from one trace that also looks at its indices and step functions.

    An index is seen where it is known while tracing: a number, or an array of numbers. Passed over are indices that
    are computed from the arguments, slices (which Python cuts off, too), and those that say what is to happen out of
    range (`mode="clip"`, `mode="fill"` with a value).

    **Arguments:**

    - `fn`: the function; it is called as `fn(*args.values())`.
    - `name`: of the function, for messages.
    - `args`: its arguments by the names for messages, pytrees of arrays.

    **Returns:**

    A pytree of `jax.ShapeDtypeStruct`.

    **Raises:**

    - `ValueError` naming the function, the index and what it is out of range of; or the line that JAX cannot trace,
      and the mend.
    """
    try:
        jaxpr, shapes = jax.make_jaxpr(fn, return_shape=True)(*args.values())
    except (TypeError, KeyError, IndexError) as error:
        said = explain(error, name, args)
        if said is None:
            raise
        raise ValueError(said) from error
    if "jaxprs" in AVAILABLE:
        names = [key + jtu.keystr(path) for key, arg in args.items() for path, _ in jtu.tree_flatten_with_path(arg)[0]]
        _follow(jaxpr, names, name)
        remark_on_steps(jaxpr, names, name)
    return shapes


def check_indices(fn: Callable[..., object], *args: object, name: str) -> None:
    """As `traced`, for a function that need not be traceable: one that is not is passed over.

    **Raises:**

    - `ValueError` as `traced`.
    """
    if "jaxprs" not in AVAILABLE:
        return
    try:
        jaxpr = jax.make_jaxpr(fn)(*args)
    except Exception:  # whatever it is: the call that follows shows it
        return
    _follow(jaxpr, [None] * len(jaxpr.in_avals), name)


@dataclass(frozen=True)
class _Access:
    """Entries of an array that are read or written at indices that are known.

    - `shape`: of the array.
    - `axes`: those that are indexed, `[k]`.
    - `starts`: indices, shape `[n, k]`; the length of the axis has been added to those below zero.
    - `sizes`: how many entries are taken from there on, `[k]`.
    - `optional`: whether entries out of range are left out. That may be meant, unless none is left.
    """

    shape: tuple[int, ...]
    axes: tuple[int, ...]
    starts: np.ndarray
    sizes: tuple[int, ...]
    optional: bool = False

    def beyond(self) -> tuple[int, int] | None:
        """Axis and index, as it was written, of the first that is out of range; None where all are within."""
        length = np.array([self.shape[axis] for axis in self.axes], int)
        last = self.starts + np.array(self.sizes, int) - 1
        out = (self.starts < 0) | (last >= length)
        if not out.any() or (self.optional and not out.any(axis=1).all()):
            return None
        row, k = np.argwhere(out)[0]
        index = self.starts[row, k] - length[k] if self.starts[row, k] < 0 else last[row, k]
        return self.axes[k], int(index)


def _sentence(array: _Known, shape: tuple[int, ...], axis: int, index: int) -> str:
    last = shape[axis] - 1
    if isinstance(array, str) and array in ("q", "qd"):
        many = "1 coordinate" if last == 0 else f"{last + 1} coordinates"
        return (
            f"{array}[{index}] is out of range: there {'is' if last == 0 else 'are'} {many}, so the last is"
            f" {array}[{last}]. Correct the index, or give q0 and qd0 an entry for each coordinate that is meant."
        )
    what = array if isinstance(array, str) else "an array"
    return (
        f"the index {index} is out of range along axis {axis} of {what} of shape {shape}, whose last is {last}. Correct"
        " the index: JAX would read another entry in silence, and write none."
    )


def _follow(closed: ClosedJaxpr | Jaxpr, inputs: Sequence[_Known], name: str) -> list[_Known]:
    """What is known of the results of a traced function, with what is known of its inputs.

    **Raises:**

    - `ValueError` naming `name` where it reads or writes at an index out of range.
    """
    jaxpr, consts = (closed.jaxpr, closed.consts) if isinstance(closed, ClosedJaxpr) else (closed, ())
    known: dict[object, _Known] = dict(zip(jaxpr.invars, inputs, strict=True))
    known.update(zip(jaxpr.constvars, map(_constant, consts), strict=False))

    def read(x: object) -> _Known:
        return _constant(x.val) if isinstance(x, Literal) else known.get(x)

    for eqn in jaxpr.eqns:
        given, kind = [read(x) for x in eqn.invars], eqn.primitive.name
        access = _access(eqn, given)
        beyond = None if access is None else access.beyond()
        if access is not None and beyond is not None:
            raise ValueError(f"In {name}, {_sentence(given[0], access.shape, *beyond)}")
        results: list[_Known] = []
        for body, body_given in _bodies(eqn, given):
            results = _follow(body, body_given, name)
        if kind in _INTEGERS and all(isinstance(x, np.ndarray) for x in given):
            aval: Any = eqn.outvars[0].aval
            results = [np.asarray(_INTEGERS[kind](*given, **eqn.params)).astype(aval.dtype)]
        elif kind not in _CALLS:
            results = []
        known.update(zip(eqn.outvars, results, strict=False))
    return [read(x) for x in jaxpr.outvars]


def _constant(value: object) -> np.ndarray | None:
    """Integers and booleans that are known."""
    if isinstance(value, jax.core.Tracer):
        return None
    kind = np.dtype(int) if isinstance(value, int) else getattr(value, "dtype", None)
    return np.asarray(value) if isinstance(kind, np.dtype) and kind.kind in "iub" else None


def _bodies(eqn: JaxprEqn, given: list[_Known]) -> list[tuple[ClosedJaxpr | Jaxpr, list[_Known]]]:
    """Functions inside an equation, with what is known of their inputs: in loops, what does not change."""
    params = eqn.params
    bodies = [
        body
        for value in params.values()
        for body in (value if isinstance(value, tuple | list) else (value,))
        if isinstance(body, ClosedJaxpr | Jaxpr)
    ]
    kind, same = eqn.primitive.name, 0
    if kind in _CALLS:
        same = len(given)
    elif kind == "scan":
        same = params["num_consts"]
    elif kind == "cond":
        which, *given = given
        same = len(given)
        if isinstance(which, np.ndarray):
            bodies = [bodies[int(np.clip(which, 0, len(bodies) - 1))]]
    inputs = [len(getattr(body, "jaxpr", body).invars) for body in bodies]
    return [(body, given[: min(same, n)] + [None] * (n - min(same, n))) for body, n in zip(bodies, inputs, strict=True)]


def _access(eqn: JaxprEqn, given: list[_Known]) -> _Access | None:
    """What an equation reads or writes; None where it is not known, or meant to be out of range."""
    kind, params = eqn.primitive.name, eqn.params
    if not (kind.startswith("scatter") or kind in ("dynamic_slice", "dynamic_update_slice", "gather")):
        return None
    avals: list[Any] = [x.aval for x in eqn.invars]
    shape = avals[0].shape
    if kind.startswith("dynamic"):
        starts, sizes = given[1:], params.get("slice_sizes")
        if sizes is None:
            starts, sizes = given[2:], avals[1].shape
        axes = [i for i, x in enumerate(starts) if isinstance(x, np.ndarray)]
        values = np.array([[starts[i] for i in axes]], int).reshape(1, len(axes))
        return _Access(shape, tuple(axes), values, tuple(sizes[i] for i in axes))
    starts, mode, numbers = given[1], params["mode"], params["dimension_numbers"]
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
    # Of jnp indexing, the mode "clip" drops the axis. Where it is kept, this is a `dynamic_slice` under vmap.
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


# Primitives that indices are computed with, in NumPy: by JAX, each would be compiled.
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
