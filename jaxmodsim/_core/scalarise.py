"""Evaluation of a function of small arrays in scalars."""

import abc
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .arrays import fusion_barrier, is_known, opaque_one
from .compat import AVAILABLE, ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun
from .lu import is_constant

# Largest number of entries of an array in scalars; tables and look-ups remain whole. 12 coordinates have 144 squares.
MAX_ENTRIES = 144
# Largest number of scalars of a function; above, compilation in scalars takes too long.
MAX_SCALARS = 8000

# Operations on single entries.
_ELEMENTWISE = {
    *("add", "add_any", "sub", "mul", "div", "neg", "abs", "sign", "max", "min", "rem", "square", "integer_pow", "pow"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
    *("exp", "exp2", "expm1", "log", "log1p", "logistic", "sqrt", "rsqrt", "cbrt", "erf", "erfc", "floor", "ceil"),
    *("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "xor", "select_n", "is_finite", "convert_element_type"),
    *("copy", "stop_gradient", "clamp", "round", "one_minus_square", "log2"),
}
# Expensive functions that XLA treats as cheap, and recomputes wherever their result is used.
_REPEATED = {"sin", "cos", "tan"}
_SUMS = {"reduce_sum", "cumsum", "dot_general"}
_INDEXED = {"gather", "scatter", "scatter-add", "dynamic_slice", "dynamic_update_slice"}
# Platforms of the choice in `jnp.diagonal`: the first is that of kernels for TPUs, not of programs.
_PROGRAMS = (("mosaic",), None)
_CALLS = {"jit", "pjit", "closed_call", "core_call"}

# Whether a function is being traced for scalars: the functions that it calls are then part of it.
_within: ContextVar[bool] = ContextVar("within", default=False)


class AbstractSymbol(abc.ABC):
    """A scalar of a generated program, of the type `dtype`."""

    dtype: np.dtype


# Entries of an array: scalars, or NumPy scalars if they are known while tracing. Any other value is one whole array.
Parts: TypeAlias = np.ndarray
Value: TypeAlias = Array | np.ndarray | np.generic | AbstractSymbol
Params: TypeAlias = dict[str, Any]  # as JAX has them


def in_scalars(fn: Callable[..., PyTree], *args: PyTree, seed: Float[Array, "..."] | None) -> PyTree:
    """Evaluate `fn(*args)` with scalars in place of small arrays.

    XLA on CPU fuses operations on arrays of two to eight entries badly, and recomputes shared terms. From scalars it
    builds one function, and under `jax.vmap` a few kernels over the batch. In addition, known numbers (the zeros and
    ones of unit vectors) pass through sums and products while tracing, and equal terms, sines and cosines are computed
    once (see `fusion_barrier`). Functions with their own derivative, loops and unsupported operations receive whole
    arrays.

    **Arguments:**

    - `fn`: a function that JAX can trace. The result is that of the plain call outside `jax.jit` and similar
      transformations, and if all values are scalars. If they have more than `MAX_SCALARS` entries in total, `fn` is
      evaluated in arrays: only entries by known indices become slices, as their derivatives do not fit into a kernel.
    - `args`: pytrees of arrays and numbers.
    - `seed`: numbers that are unknown while compiling. If the first is not finite, the result may not be finite. None
      for an evaluation in arrays.

    **Returns:**

    The result of `fn` up to rounding, except that zero times infinity is zero if that zero is a constant.
    """
    if _within.get() or "jaxprs" not in AVAILABLE:
        return fn(*args)
    closed, shapes = trace_in_arrays(fn, *args)
    leaves = [x if hasattr(x, "shape") else jnp.asarray(x) for x in jtu.tree_leaves(args)]
    sizes = [size for size in sizes_of(closed.jaxpr) if size <= MAX_ENTRIES]
    seed = seed if sum(sizes) <= MAX_SCALARS else None
    if is_known(*leaves) or (seed is None and not _has_indices(closed.jaxpr)):
        return fn(*args)
    if max(sizes, default=0) > 1:
        unit = None if seed is None else opaque_one(jax.lax.stop_gradient(jnp.ravel(seed)[0]))
        out = [jnp.asarray(_whole(x)) for x in _Scalars(unit).run(closed.jaxpr, closed.consts, leaves)]
    else:
        out = jaxpr_as_fun(closed)(*leaves)
    return jtu.tree_unflatten(jtu.tree_structure(shapes), out)


def trace_in_arrays(fn: Callable[..., PyTree], *args: PyTree) -> tuple[ClosedJaxpr, PyTree]:
    """Trace of `fn(*args)` in whole arrays, and the shapes of its result."""
    outside = _within.set(True)
    try:
        return jax.make_jaxpr(fn, return_shape=True)(*args)
    finally:
        _within.reset(outside)


def columns_of(linear: Callable[..., list[Value]], unit: Float[Array, ""], *like: ArrayLike) -> list[list[Value]]:
    """Columns of the matrix of a linear function of scalars, with structural zeros and ones as known numbers.

    **Arguments:**

    - `linear`: a function from scalars to a list of scalars, such as the second result of `jax.linearize`.
    - `unit`: a one from `opaque_one`.
    - `like`: scalars with the types of its arguments.

    **Returns:**

    For each argument the values of `linear` if that argument is one and all others are zero: NumPy scalars for values
    that are known while tracing, otherwise arrays.
    """
    types = [jnp.result_type(x) for x in like]
    if "jaxprs" not in AVAILABLE:
        return [linear(*(jnp.asarray(i == j, kind) for i, kind in enumerate(types))) for j in range(len(like))]
    closed, scalars = jax.make_jaxpr(linear)(*like), _Scalars(unit)
    columns = []
    for j in range(len(like)):
        basis = [np.asarray(i == j, kind) for i, kind in enumerate(types)]
        out = scalars.run(closed.jaxpr, closed.consts, basis)
        columns.append([x[()] if isinstance(x, np.ndarray) else x for x in out])
    return columns


def _needed(jaxpr: Jaxpr) -> list[JaxprEqn]:
    """The equations of a traced function on which its outputs depend."""
    live, needed = set(map(id, jaxpr.outvars)), []
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or any(id(var) in live for var in eqn.outvars):
            live.update(map(id, eqn.invars))
            needed.append(eqn)
    return needed[::-1]


def sizes_of(jaxpr: Any) -> list[int]:
    """Number of entries of each value of a traced function."""
    inner = [eqn.params["jaxpr"].jaxpr for eqn in jaxpr.eqns if eqn.primitive.name in _CALLS]
    own = [var.aval.size for eqn in jaxpr.eqns for var in eqn.outvars]
    return own + [size for each in inner for size in sizes_of(each)]


def _has_indices(jaxpr: Jaxpr) -> bool:
    """Whether a traced function reads or writes entries by an array of indices, or may do so on some platform."""
    inner = [eqn.params["jaxpr"].jaxpr for eqn in jaxpr.eqns if eqn.primitive.name in _CALLS]
    own = any(eqn.primitive.name in (*_INDEXED, "platform_index") for eqn in jaxpr.eqns)
    return own or any(map(_has_indices, inner))


def _entries(shape: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    return itertools.product(*map(range, shape))


def array_of(shape: tuple[int, ...], entry: Callable[[tuple[int, ...]], Value]) -> Parts:
    """An array of scalars from a function of the index."""
    out = np.empty(shape, object)
    for index in _entries(shape):
        out[index] = entry(index)
    return out


def _whole(x: Any) -> Any:
    """A value as one array."""
    if not is_apart(x):
        return x
    if (known := known_array(x)) is not None:
        return known
    # Row by row: XLA recognizes the entries of a stack, but not after a reshape.
    return jnp.asarray(x[()]) if x.shape == () else jnp.stack([_whole(x[i, ...]) for i in range(len(x))])


def is_apart(x: object) -> bool:
    return isinstance(x, np.ndarray) and x.dtype == object


def known_array(x: Value) -> np.ndarray | None:
    """A value as an array of numbers; None if any entry is not known."""
    if not isinstance(x, np.ndarray | np.generic):
        return None
    if not is_apart(x):
        return np.asarray(x)
    if x.size == 0 or not all(map(is_constant, x.flat)):
        return None
    return np.asarray(x.tolist(), x.flat[0].dtype)


class AbstractScalars(abc.ABC):
    """Evaluates a traced function entry by entry, and reuses equal terms.

    Entries are NumPy scalars if they are known while tracing, otherwise results of `scalar`. Without `divided` only
    operations on known numbers, and moves to known places, are evaluated entry by entry.
    """

    def __init__(self, divided: bool = True) -> None:
        self.memory: dict[object, tuple[object, Any]] = {}
        self.divided = divided

    @abc.abstractmethod
    def scalar(self, compute: Callable[..., Value], name: str, params: Params, operands: list[Value]) -> Value:
        """One scalar by the operation `name` of JAX, `compute(*operands, **params)`."""

    @abc.abstractmethod
    def whole(self, eqn: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Outputs of an equation on whole arrays."""

    @abc.abstractmethod
    def divides(self, size: int) -> bool:
        """Whether arrays of this size are evaluated entry by entry."""

    def parts(self, x: Any) -> Parts:
        """A value as an array of scalars."""
        if is_apart(x):
            return x
        if isinstance(x, np.ndarray):
            return array_of(x.shape, lambda index: x[index])
        if id(x) not in self.memory:
            entries = iter(jnp.unstack(jnp.reshape(x, -1)))
            self.memory[id(x)] = x, array_of(x.shape, lambda _: next(entries))
        return self.memory[id(x)][1]

    def run(self, jaxpr: Jaxpr, consts: Sequence[ArrayLike], args: Sequence[Value]) -> list[Value]:
        """Values of the outputs, in scalars or whole."""
        values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(_constant, consts), *args], strict=True))

        def read(atom: Any) -> Value:
            kind: Any = atom.aval
            return np.asarray(atom.val, kind.dtype) if isinstance(atom, Literal) else values[atom]

        for eqn in _needed(jaxpr):
            values.update(zip(eqn.outvars, self.step(eqn, [read(x) for x in eqn.invars]), strict=True))
        return [read(x) for x in jaxpr.outvars]

    def step(self, eqn: Any, inputs: list[Value]) -> Sequence[Value]:
        """Outputs of one equation."""
        name, params = eqn.primitive.name, eqn.params
        if name in _CALLS:
            return self.run(params["jaxpr"].jaxpr, params["jaxpr"].consts, inputs)
        if name == "platform_index" and params["platforms"] == _PROGRAMS:
            return [np.asarray(1)]
        if name == "cond" and (index := known_array(inputs[0])) is not None:
            chosen = params["branches"][int(np.clip(int(index), 0, len(params["branches"]) - 1))]
            return self.run(chosen.jaxpr, chosen.consts, inputs[1:])
        kinds = [x.aval for x in (*eqn.invars, *eqn.outvars)]
        if not all(self.divides(kind.size) for kind in kinds):
            return self.whole(eqn, inputs)
        if name in _INDEXED and (places := _places(eqn, inputs)) is not None:
            return [self.at_places(name, places, *map(self.parts, inputs[:3]))]
        if not self.divided and not (name in _KNOWN | _MOVES and all(known_array(x) is not None for x in inputs)):
            return self.whole(eqn, inputs)
        if name in _ELEMENTWISE:
            arrays, compute = np.broadcast_arrays(*map(self.parts, inputs)), eqn.primitive.bind
            return [array_of(arrays[0].shape, lambda i: self.apply(compute, name, params, [x[i] for x in arrays]))]
        if name in _MOVES:
            return [_MOVES[name](params, *map(self.parts, inputs))]
        if name == "split":
            return np.split(self.parts(inputs[0]), np.cumsum(params["sizes"])[:-1], params["axis"])
        if name == "unstack":
            moved = np.moveaxis(self.parts(inputs[0]), params["axis"], 0)
            return [moved[i, ...] for i in range(len(moved))]
        if name in _SUMS and len({kind.dtype for kind in kinds}) == 1 and all(kind.size for kind in kinds):
            return [getattr(self, name)(params, *map(self.parts, inputs))]
        return self.whole(eqn, inputs)

    def apply(self, compute: Callable[..., Value], name: str, params: Params, operands: list[Value]) -> Value:
        """One scalar by an operation on scalars, or a known or equal one."""
        if all(map(is_constant, operands)) and name in _KNOWN:
            with np.errstate(all="ignore"):  # overflow and NaN without a word, as in JAX
                return np.asarray(_KNOWN[name](params, *operands))[()]
        short = _shorten(name, operands)
        if short is not None:
            return short
        key = (
            name,
            str(params),
            *(np.asarray(x).tobytes() + x.dtype.str.encode() if is_constant(x) else id(x) for x in operands),
        )
        if key not in self.memory:
            # The memory keeps the operands alive, so that their ids remain unique.
            self.memory[key] = operands, self.scalar(compute, name, params, operands)
        return self.memory[key][1]

    def add(self, a: Value, b: Value) -> Value:
        return self.apply(jax.lax.add, "add", {}, [a, b])

    def at_places(self, name: str, places: np.ndarray, x: Parts, *others: Parts) -> Parts:
        """The entries at these places of a flat array; or the array with updates there, the last of `others`."""
        flat = x.reshape(-1).copy()
        if name in ("gather", "dynamic_slice"):
            return array_of(places.shape, lambda i: flat[places[i]])
        updates = others[0] if name == "dynamic_update_slice" else others[1]
        for place, update in zip(places.flat, updates.flat, strict=True):
            flat[place] = self.add(flat[place], update) if name == "scatter-add" else update
        return flat.reshape(x.shape)

    def reduce_sum(self, params: Params, x: Parts) -> Parts:
        axes = params["axes"]
        x = np.moveaxis(x, axes, range(len(axes)))
        x = x.reshape(-1, *x.shape[len(axes) :])
        return array_of(x.shape[1:], lambda i: functools.reduce(self.add, x[(slice(None), *i)]))

    def cumsum(self, params: Params, x: Parts) -> Parts:
        step = -1 if params["reverse"] else 1
        x = np.moveaxis(x, params["axis"], 0)[::step].copy()
        for k in range(1, x.shape[0]):
            for i in _entries(x.shape[1:]):
                x[(k, *i)] = self.add(x[(k - 1, *i)], x[(k, *i)])
        return np.moveaxis(x[::step], 0, params["axis"])

    def dot_general(self, params: Params, a: Parts, b: Parts) -> Parts:
        (sum_a, sum_b), (batch_a, batch_b) = params["dimension_numbers"]
        free_a = [i for i in range(a.ndim) if i not in (*sum_a, *batch_a)]
        free_b = [i for i in range(b.ndim) if i not in (*sum_b, *batch_b)]
        a, b = a.transpose(*batch_a, *free_a, *sum_a), b.transpose(*batch_b, *free_b, *sum_b)
        batch, rows, columns = len(batch_a), len(free_a), len(free_b)

        def entry(i: tuple[int, ...]) -> Value:
            left, right = a[(*i[: batch + rows], ...)], b[(*i[:batch], *i[batch + rows :], ...)]
            pairs = zip(left.flat, right.flat, strict=True)
            return functools.reduce(self.add, [self.apply(jax.lax.mul, "mul", {}, [x, y]) for x, y in pairs])

        return array_of((*a.shape[: batch + rows], *b.shape[batch : batch + columns]), entry)


class _Scalars(AbstractScalars):
    """Scalars of JAX. Without a `unit`, a one from `opaque_one`, arrays remain whole where that is possible."""

    def __init__(self, unit: Array | None) -> None:
        super().__init__(divided=unit is not None)
        self.unit = unit

    def scalar(self, compute: Callable[..., Value], name: str, params: Params, operands: list[Value]) -> Value:
        """The operation of JAX."""
        out = compute(*operands, **params)
        return out if self.unit is None or name not in _REPEATED else fusion_barrier(out, self.unit)

    def divides(self, size: int) -> bool:
        """Whether arrays of this size are small."""
        return 0 < size <= MAX_ENTRIES

    def whole(self, eqn: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Outputs of an equation on whole arrays."""
        bound = eqn.primitive.get_bind_params(eqn.params)
        functions, params = bound if isinstance(bound, tuple) else ((), bound)
        out = eqn.primitive.bind(*functions, *map(_whole, inputs), **params)
        return list(out) if eqn.primitive.multiple_results else [out]


def _constant(x: Any) -> Value:
    return np.asarray(x) if is_known(x) else x


def _shorten(name: str, operands: list[Value]) -> Value | None:
    """Result of a sum, product or quotient with zero or one, or of a trivial choice; otherwise None."""
    if name in ("add", "add_any", "mul"):
        for a, b in (operands, operands[::-1]):
            if is_constant(a) and a == 0:
                return a if name == "mul" else b
            if is_constant(a) and a == 1 and name == "mul":
                return b
    if name == "select_n":
        chosen, *cases = operands
        if is_constant(chosen):
            return cases[int(np.asarray(chosen))]
        # Equal known cases: for example, the derivative of |v| by an unrelated variable is zero on both sides.
        if all(map(is_constant, cases)) and all(x == cases[0] for x in cases):
            return cases[0]
    if name == "div" and is_constant(operands[0]) and operands[0] == 0:
        return operands[0]
    if name == "sub" and is_constant(operands[1]) and operands[1] == 0:
        return operands[0]
    return None


def _places(eqn: Any, inputs: list[Value]) -> np.ndarray | None:
    """Places in the flat first operand that an operation reads or writes; None if not known, or out of range."""
    name, params, shape = eqn.primitive.name, eqn.params, eqn.invars[0].aval.shape
    numbers = np.arange(math.prod(shape)).reshape(shape)
    if name.startswith("dynamic"):
        window = params.get("slice_sizes", eqn.invars[1].aval.shape)
        starts = [known_array(x) for x in inputs[-len(shape) :]]
        if any(start is None for start in starts):
            return None
        within = zip(starts, shape, window, strict=True)
        begins = [int(np.clip(int(np.asarray(start)), 0, size - width)) for start, size, width in within]
        return numbers[tuple(slice(i, i + width) for i, width in zip(begins, window, strict=True))]
    indices, dims = eqn.invars[1].aval, params["dimension_numbers"]
    starts = known_array(inputs[1]) if indices.size else np.zeros(indices.shape, int)
    applied = name == "scatter" and params["update_jaxpr"] is not None  # `x.at[indices].apply`
    if starts is None or dims.operand_batching_dims or applied:
        return None
    if name == "gather":
        single, moved, axes = dims.collapsed_slice_dims, dims.start_index_map, dims.offset_dims
        window = params["slice_sizes"]
    else:
        single, moved, axes = dims.inserted_window_dims, dims.scatter_dims_to_operand_dims, dims.update_window_dims
        widths = (eqn.invars[2].aval.shape[axis] for axis in axes)
        window = tuple(1 if axis in single else next(widths) for axis in range(len(shape)))
    batch = starts.shape[:-1]
    begin = np.zeros((*batch, len(shape)), int)
    begin[..., list(moved)] = starts
    at = [begin[..., i].reshape(*batch, *[1] * len(shape)) + each for i, each in enumerate(np.indices(window))]
    if any(np.any((each < 0) | (each >= size)) for each, size in zip(at, shape, strict=True)):
        return None
    places = numbers[tuple(at)].squeeze(tuple(len(batch) + axis for axis in single))
    return np.moveaxis(places, range(len(batch), places.ndim), axes)


def _pad(params: Params, x: Parts, filling: Parts) -> Parts:
    config = [tuple(map(int, sizes)) for sizes in params["padding_config"]]
    shape = tuple(
        low + high + size + inner * max(size - 1, 0) for size, (low, high, inner) in zip(x.shape, config, strict=True)
    )
    out = array_of(shape, lambda _: filling[()])
    for i in _entries(x.shape):
        to = tuple(low + k * (inner + 1) for k, (low, _, inner) in zip(i, config, strict=True))
        if all(0 <= k < size for k, size in zip(to, shape, strict=True)):
            out[to] = x[i]
    return out


def _broadcast(params: Params, x: Parts) -> Parts:
    shape = [1] * len(params["shape"])
    for dimension, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[dimension] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(params: Params, x: Parts) -> Parts:
    strides = params["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _iota(params: Params) -> Parts:
    shape, dimension = params["shape"], params["dimension"]
    return array_of(shape, lambda i: np.dtype(params["dtype"]).type(i[dimension]))


# Operations that move entries.
_MOVES: dict[str, Callable[..., Parts]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *xs: np.concatenate(xs, params["dimension"]),
    "iota": _iota,
    "pad": _pad,
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "rev": lambda params, x: np.flip(x, params["dimensions"]),
    "slice": _slice,
    "stack": lambda params, *xs: np.stack(xs, params["axis"]),
    "squeeze": lambda params, x: np.squeeze(x, params["dimensions"]),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
}

# Operations that are evaluated while tracing if their operands are known.
_KNOWN: dict[str, Callable[..., ArrayLike]] = {
    "add": lambda _, a, b: a + b,
    "add_any": lambda _, a, b: a + b,
    "convert_element_type": lambda params, x: x.astype(params["new_dtype"]),
    "eq": lambda _, a, b: a == b,
    "ge": lambda _, a, b: a >= b,
    "lt": lambda _, a, b: a < b,
    "mul": lambda _, a, b: a * b,
    "neg": lambda _, x: -x,
    "select_n": lambda _, chosen, *cases: cases[int(chosen)],
    "sub": lambda _, a, b: a - b,
}
