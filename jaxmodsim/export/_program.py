"""A traced function as a list of statements on scalars, for translation to another language."""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from .._core.compat import AVAILABLE, ClosedJaxpr, JaxprEqn, scan_counts
from .._core.lu import is_constant
from .._core.scalarise import AbstractScalars, AbstractSymbol, Params, Parts, Value, array_of, known_array

_COMPARISONS = {"eq", "ne", "lt", "le", "gt", "ge", "is_finite"}
_FOLDS = {"reduce_max": jax.lax.max, "reduce_min": jax.lax.min, "reduce_prod": jax.lax.mul}
_FOLDS |= {"reduce_and": jax.lax.bitwise_and, "reduce_or": jax.lax.bitwise_or}
_ARGUMENTS = {"argmin": (jax.lax.lt, "lt"), "argmax": (jax.lax.gt, "gt")}
# Largest number of entries of an array in generated code.
_MOST_ENTRIES = 10_000
_FUNCTIONS = {"custom_jvp_call", "custom_vjp_call"}


class Symbol(AbstractSymbol):
    """A scalar of the program: the result of a statement, or an argument, which already has a name."""

    def __init__(self, dtype: np.dtype, name: str | None = None) -> None:
        self.dtype = np.dtype(dtype)
        self.name = name


Entry: TypeAlias = Symbol | np.generic


class Assign(NamedTuple):
    """`out` is the operation `name` of JAX on `operands`."""

    out: Symbol
    name: str
    operands: list[Entry]


class Carry(NamedTuple):
    """A variable of a loop: `symbol` is `start` in the first iteration and `after` in the next one."""

    symbol: Symbol
    start: Entry
    after: Entry


class Loop(NamedTuple):
    """At most `bound` iterations of `head`, an exit unless `condition` is true, and `body`."""

    bound: int
    carries: list[Carry]
    head: "Block"
    condition: Entry
    body: "Block"


class Choice(NamedTuple):
    """The arm with the index `chosen`, or else the last one; each arm is a block with the values of `outs`."""

    chosen: Entry
    outs: list[Symbol]
    arms: list[tuple["Block", list[Entry]]]


Statement: TypeAlias = Assign | Loop | Choice
Block: TypeAlias = list[Statement]


class Program(NamedTuple):
    """Statements and their results."""

    block: Block
    results: list[Entry]


def program_of(closed: ClosedJaxpr, arguments: Sequence[Symbol]) -> Program:
    """The statements of a traced function of scalars, without those that do not affect a result.

    **Raises:**

    - `ValueError` naming an unknown operation.
    - `RuntimeError` if this release of JAX does not provide the traced statements.
    """
    if "jaxprs" not in AVAILABLE:
        raise RuntimeError(
            f"to_c reads traced functions by jax.extend.core, which is different in jax {jax.__version__}."
            " Install jax>=0.10,<0.13."
        )
    writer = _StatementWriter()
    inputs: list[Value] = [_scalar_array(x) for x in arguments]
    outputs = writer.run(closed.jaxpr, closed.consts, inputs)
    results = [x for each in outputs for x in writer.parts(each).flat]
    # Results overwrite arguments: a result that is an argument itself is copied first.
    copied = [writer.assign("copy", [x]) if isinstance(x, Symbol) and x.name else x for x in results]
    return Program(_needed(writer.block, {x for x in copied if isinstance(x, Symbol)}), copied)


def _scalar_array(x: Value) -> Parts:
    return array_of((), lambda _: x)


def _one(dtype: np.dtype) -> np.generic:
    return dtype.type(1)


class _StatementWriter(AbstractScalars):
    """Writes a statement for every scalar that is not a constant."""

    def __init__(self) -> None:
        super().__init__()
        self.block: Block = []
        self.origin: dict[Symbol, Assign] = {}

    def assign(self, name: str, operands: list[Entry], dtype: np.dtype | None = None) -> Symbol:
        out = Symbol(operands[-1].dtype if dtype is None else dtype)
        self.origin[out] = Assign(out, name, operands)
        self.block.append(self.origin[out])
        return out

    def scalar(self, compute: Callable[..., Any], name: str, params: Params, operands: list[Any]) -> Any:
        """A statement, or an equal value without one."""
        if all(map(is_constant, operands)):
            return np.asarray(compute(*operands, **params))[()]
        first = operands[0]
        if name == "convert_element_type":
            kind = np.dtype(params["new_dtype"])
            return first if kind == first.dtype else self.converted(compute, first, params)
        if name in ("copy", "stop_gradient"):
            return first
        if name in ("and", "or") and first.dtype == bool and any(map(is_constant, operands)):
            known, other = operands if is_constant(first) else operands[::-1]
            return other if bool(known) == (name == "and") else known
        if name == "sub" and first is operands[1]:
            return np.zeros((), first.dtype)[()]
        if name == "neg" and first in self.origin and self.origin[first].name == "neg":
            return self.origin[first].operands[0]
        if name == "div" and is_constant(operands[1]) and operands[1] == 1:
            return first
        if name == "select_n" and operands[1] is operands[2] and len(operands) == 3:
            return operands[1]
        if name in _COMPARISONS:
            return self.assign(name, operands, np.dtype(bool))
        if name == "integer_pow":
            return self.power(first, params["y"])
        if name == "square":
            return self.apply(jax.lax.mul, "mul", {}, [first, first])
        if name == "one_minus_square":  # from JAX 0.11
            one = _one(first.dtype)
            return self.assign("mul", [self.assign("sub", [one, first]), self.assign("add", [one, first])])
        if name in ("rsqrt", "logistic"):
            one = _one(first.dtype)
            if name == "rsqrt":
                return self.assign("div", [one, self.assign("sqrt", operands)])
            return self.assign(
                "div", [one, self.assign("add", [one, self.assign("exp", [self.assign("neg", operands)])])]
            )
        if name == "clamp":
            low, x, high = operands
            return self.apply(jax.lax.min, "min", {}, [self.apply(jax.lax.max, "max", {}, [x, low]), high])
        if name == "round" and int(params["rounding_method"]) != int(jax.lax.RoundingMethod.TO_NEAREST_EVEN):
            raise ValueError("round halves away from zero")
        return self.assign("add" if name == "add_any" else name, operands)

    def converted(self, compute: Callable[..., Value], x: Symbol, params: Params) -> Value:
        """Convert to another type; of a selection from constants, the constants are converted."""
        origin = self.origin.get(x)
        if origin is None or origin.name != "select_n" or not all(map(is_constant, origin.operands[1:])):
            return self.assign("convert_element_type", [x], np.dtype(params["new_dtype"]))
        chosen, *cases = origin.operands
        cases = [self.scalar(compute, "convert_element_type", params, [case]) for case in cases]
        return self.apply(jax.lax.select_n, "select_n", {}, [chosen, *cases])

    def power(self, x: Value, exponent: int) -> Value:
        """Products, in the order of JAX."""
        out: Value = _one(x.dtype)
        for digit in bin(abs(exponent))[:1:-1]:
            if digit == "1":
                out = self.apply(jax.lax.mul, "mul", {}, [out, x])
            x = self.apply(jax.lax.mul, "mul", {}, [x, x])
        return out if exponent >= 0 else self.apply(jax.lax.div, "div", {}, [_one(x.dtype), out])

    def whole(self, eqn: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Loops, branches, calls, slices at computed indices, and known results."""
        name, params = eqn.primitive.name, eqn.params
        if name in _FUNCTIONS:
            called = params["call_jaxpr"]
            return self.run(called.jaxpr, called.consts, inputs)
        if name == "platform_index":
            return [np.asarray(params["platforms"].index(("cpu",)) if ("cpu",) in params["platforms"] else 0)]
        if name == "while":
            return self.loop(params, inputs)
        if name == "scan":
            return self.scan(params, inputs)
        if name == "cond":
            return self.branch(params["branches"], inputs)
        kinds: list[Any] = [var.aval for var in eqn.invars]
        known = [
            known_array(x) if kind.size else np.asarray(np.zeros(kind.shape, kind.dtype))
            for kind, x in zip(kinds, inputs, strict=True)
        ]
        if all(x is not None for x in known):
            out = eqn.primitive.bind(*known, **params)
            return [np.asarray(x) for x in (out if eqn.primitive.multiple_results else [out])]
        sizes = [self.parts(x).size for x in inputs]
        if name in _FOLDS:
            axes = tuple(map(int, params["axes"]))
            operation = name.removeprefix("reduce_").replace("prod", "mul")
            return [self.fold(_FOLDS[name], operation, axes, self.parts(inputs[0]))]
        if name in _ARGUMENTS and len(params["axes"]) == 1:
            return [self.argument(*_ARGUMENTS[name], params, self.parts(inputs[0]))]
        if name == "dynamic_slice" and any(x is None for x in known[1:]):
            return [self.slice_at(params["slice_sizes"], self.parts(inputs[0]), inputs[1:])]
        raise ValueError(f"{name} of arrays with {max(sizes)} entries" if max(sizes) > 1 else name)

    def divides(self, size: int) -> bool:
        """Whether arrays of this size are written entry by entry."""
        return size <= _MOST_ENTRIES

    def fold(self, compute: Callable[..., Any], name: str, axes: tuple[int, ...], x: Parts) -> Parts:
        x = np.moveaxis(x, axes, range(len(axes)))
        x = x.reshape(-1, *x.shape[len(axes) :])

        def entry(i: tuple[int, ...]) -> Value:
            return functools.reduce(lambda a, b: self.apply(compute, name, {}, [a, b]), x[(slice(None), *i)])

        return array_of(x.shape[1:], entry)

    def choose(self, test: Parts, one: Parts, other: Parts) -> Parts:
        """`one` where `test`, which has the leading axes of both, is true, else `other`."""

        def entry(i: tuple[int, ...]) -> Value:
            return self.apply(jax.lax.select_n, "select_n", {}, [test[i[: test.ndim]], other[i], one[i]])

        return array_of(one.shape, entry)

    def argument(self, compute: Callable[..., Any], name: str, params: Params, x: Parts) -> Parts:
        """Index of the first of the smallest, or largest, entries along an axis."""
        x, kind = np.moveaxis(x, params["axes"][0], 0), np.dtype(params["index_dtype"]).type
        out = np.empty(x.shape[1:], object)
        for i in np.ndindex(*out.shape):
            best, out[i] = x[(0, *i)], kind(0)
            for k in range(1, len(x)):
                better = self.apply(compute, name, {}, [x[(k, *i)], best])
                best = self.apply(jax.lax.select_n, "select_n", {}, [better, best, x[(k, *i)]])
                out[i] = self.apply(jax.lax.select_n, "select_n", {}, [better, out[i], kind(k)])
        return out

    def slice_at(self, sizes: Sequence[int], x: Parts, starts: Sequence[Value]) -> Parts:
        """A slice that starts at computed indices, which are clamped: a choice among all slices."""
        for axis, (size, start) in enumerate(zip(sizes, starts, strict=True)):
            (at,) = self.parts(start).flat
            last = x.shape[axis] - size
            slices = [np.take(x, range(k, k + size), axis) for k in range(last + 1)]
            x = slices[0]
            for k in range(1, last + 1):
                beyond = self.apply(jax.lax.ge, "ge", {}, [at, at.dtype.type(k)])
                x = self.choose(_scalar_array(beyond), slices[k], x)
        return x

    @contextmanager
    def inner_block(self) -> Iterator[Block]:
        """A nested block; its results are not available after it."""
        block, memory = self.block, self.memory
        self.block, self.memory = [], dict(memory)
        try:
            yield self.block
        finally:
            self.block, self.memory = block, memory

    def loop(self, params: Params, inputs: list[Value]) -> list[Value]:
        """A loop with a bounded number of iterations."""
        test, body = params["cond_jaxpr"], params["body_jaxpr"]
        n_test, n_body = params["cond_nconsts"], params["body_nconsts"]
        test_consts, body_consts = inputs[:n_test], inputs[n_test : n_test + n_body]
        starts = [self.parts(x) for x in inputs[n_test + n_body :]]
        same = [a is b for a, b in zip(body.jaxpr.outvars, body.jaxpr.invars[n_body:], strict=True)]
        symbols = [x if kept else _symbols(x) for x, kept in zip(starts, same, strict=True)]
        with self.inner_block() as head:
            # Under vmap one condition for each member, whose variables change while its own condition is true.
            conditions = self.parts(self.run(test.jaxpr, test.consts, [*test_consts, *symbols])[0])
            either: Any = functools.reduce(
                lambda a, b: self.apply(jax.lax.bitwise_or, "or", {}, [a, b]), conditions.flat
            )
            self.block = []
            after = [self.parts(x) for x in self.run(body.jaxpr, body.consts, [*body_consts, *symbols])]
            changed = [
                each for each, kept in zip(zip(symbols, starts, after, strict=True), same, strict=True) if not kept
            ]
            carries = [Carry(*each) for parts in changed for each in zip(*(x.flat for x in parts), strict=True)]
            bound = max(self.bound(each, carries) for each in conditions.flat)
            if conditions.ndim:
                held = [self.choose(conditions, x, symbol) for symbol, _, x in changed]
                flat = [x for parts in held for x in parts.flat]
                carries = [carry._replace(after=x) for carry, x in zip(carries, flat, strict=True)]
            inside = self.block
        self.block.append(Loop(bound, carries, head, either, inside))
        return list(symbols)

    def scan(self, params: Params, inputs: list[Value]) -> list[Value]:
        """A loop with a known number of iterations, written out if it reads or writes rows of arrays."""
        (n_consts, n_carry), body, length = scan_counts(params), params["jaxpr"], params["length"]
        consts, inputs = inputs[:n_consts], inputs[n_consts:]
        starts, rows = [self.parts(x) for x in inputs[:n_carry]], [self.parts(x) for x in inputs[n_carry:]]
        if rows or len(body.jaxpr.outvars) > n_carry or length == 1:
            outputs: list[list[Value]] = []
            carry: list[Value] = list(starts)
            for k in range(length)[:: -1 if params["reverse"] else 1]:
                out = self.run(body.jaxpr, body.consts, [*consts, *carry, *(x[k, ...] for x in rows)])
                carry = out[:n_carry]
                outputs.append(out[n_carry:])
            outputs = outputs[:: -1 if params["reverse"] else 1]
            return [*carry, *(np.stack([self.parts(x) for x in column]) for column in zip(*outputs, strict=True))]
        symbols = [_symbols(x) for x in starts]
        with self.inner_block() as inside:
            after = [self.parts(x) for x in self.run(body.jaxpr, body.consts, [*consts, *symbols])]
        triples = zip(symbols, starts, after, strict=True)
        carries = [Carry(*each) for parts in triples for each in zip(*(x.flat for x in parts), strict=True)]
        self.block.append(Loop(length, carries, [], np.bool_(True), inside))
        return list(symbols)

    def bound(self, condition: Entry, carries: list[Carry]) -> int:
        """Largest number of iterations, from a counter that the condition compares with a constant."""
        bounds, conjuncts = [], [condition]
        while conjuncts:
            x = conjuncts.pop()
            if not isinstance(x, Symbol) or x not in self.origin:
                continue
            _, name, operands = self.origin[x]
            if name == "and":
                conjuncts += operands
            if name != "lt" or not is_constant(operands[1]):
                continue
            for carry in carries:
                step = self.origin.get(carry.after) if isinstance(carry.after, Symbol) else None
                counts = step is not None and step.name == "add" and step.operands[0] is carry.symbol
                if operands[0] is carry.symbol and is_constant(carry.start) and step is not None and counts:
                    by = step.operands[1]
                    if is_constant(by) and by == 1:
                        bounds.append(int(np.asarray(operands[1])) - int(np.asarray(carry.start)))
        if not bounds:
            raise ValueError("while, a loop without a known limit of its iterations")
        return min(bounds)

    def branch(self, branches: Sequence[ClosedJaxpr], inputs: list[Value]) -> list[Value]:
        """Arms, one of which is executed."""
        (index,) = self.parts(inputs[0]).flat
        arms = []
        for each in branches:
            with self.inner_block() as block:
                outputs = self.run(each.jaxpr, each.consts, inputs[1:])
                arms.append((block, [x for out in outputs for x in self.parts(out).flat]))
        outs = [_symbols(np.empty(x.aval.shape), x.aval.dtype) for x in branches[0].jaxpr.outvars]
        self.block.append(Choice(index, [x for out in outs for x in out.flat], arms))
        return list(outs)


def _symbols(like: np.ndarray, dtype: np.dtype | None = None) -> Parts:
    """New symbols with the types of these entries."""
    return array_of(like.shape, lambda i: Symbol(like[i].dtype if dtype is None else dtype))


def _needed(block: Block, live: set[Symbol]) -> Block:
    """The statements on which the symbols `live` depend; adds their inputs to `live`."""
    kept: Block = []
    for statement in reversed(block):
        if isinstance(statement, Assign):
            if statement.out in live:
                kept.append(statement)
                _add(live, statement.operands)
        elif isinstance(statement, Choice):
            wanted = [out in live for out in statement.outs]
            if any(wanted):
                _add(live, [statement.chosen])
                arms = []
                for inside, results in statement.arms:
                    results = [x for x, each in zip(results, wanted, strict=True) if each]
                    _add(live, results)
                    arms.append((_needed(inside, live), results))
                outs = [x for x, each in zip(statement.outs, wanted, strict=True) if each]
                kept.append(Choice(statement.chosen, outs, arms))
        elif any(carry.symbol in live for carry in statement.carries):
            kept.append(_needed_loop(statement, live))
    return kept[::-1]


def _needed_loop(loop: Loop, live: set[Symbol]) -> Loop:
    """The loop with those carries alone that affect its results or its end."""
    _add(live, [loop.condition])
    head, body, carries, size = [], [], [], -1
    while size < len(live):
        size = len(live)
        carries = [carry for carry in loop.carries if carry.symbol in live]
        _add(live, [carry.after for carry in carries])
        body = _needed(loop.body, live)
        head = _needed(loop.head, live)
    _add(live, [carry.start for carry in carries])
    return Loop(loop.bound, carries, head, loop.condition, body)


def _add(live: set[Symbol], entries: Sequence[Entry]) -> None:
    live.update(x for x in entries if isinstance(x, Symbol))
