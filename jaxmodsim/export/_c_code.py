"""Statements on scalars as C99."""

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._core.scalarise import trace_in_arrays
from ._program import Assign, Block, Choice, Entry, Loop, Symbol, program_of

# Operands are names or literals.
_FORMS = {
    **{"add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}", "neg": "-{0}", "copy": "{0}"},
    **{"lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}", "ge": "{0} >= {1}"},
    **{"eq": "{0} == {1}", "ne": "{0} != {1}", "and": "{0} && {1}", "or": "{0} || {1}", "xor": "{0} != {1}"},
    "not": "!{0}",
    # inf - inf is NaN.
    "is_finite": "{0} - {0} == 0",
    "select_n": "{0} ? {2} : {1}",
    "sign": "{0} > 0 ? 1 : {0} < 0 ? -1 : {0}",
    # NaN if either is.
    "max": "{0} != {0} || {0} > {1} ? {0} : {1}",
    "min": "{0} != {0} || {0} < {1} ? {0} : {1}",
}
_LOGICAL = {"and", "or", "xor", "not"}
_FUNCTIONS = {"sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"}
_FUNCTIONS |= {"exp", "exp2", "expm1", "log", "log1p", "log2", "sqrt", "cbrt", "floor", "ceil", "pow", "erf", "erfc"}
_NAMES = {name: name for name in _FUNCTIONS} | {"abs": "fabs", "rem": "fmod", "round": "rint"}
_TYPES = {"f64": "double", "f32": "float", "i": "int", "b8": "int"}


def type_of(dtype: np.dtype) -> str:
    """Name of a type.

    **Raises:**

    - `ValueError` naming an unsupported type.
    """
    kind = "i" if dtype.kind in "iu" else dtype.kind + str(8 * dtype.itemsize)
    if kind not in _TYPES:
        raise ValueError(f"numbers of {dtype}: C99 has no {dtype}")
    return _TYPES[kind]


def literal(x: np.generic) -> str:
    """A literal with the exact value of a number."""
    if x.dtype.kind in "biu":
        return str(int(np.asarray(x)))
    value = float(np.asarray(x))
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return "NAN" if math.isnan(value) else str(x) + _suffix(x.dtype)


def _suffix(dtype: np.dtype) -> str:
    """Ending of literals and of functions."""
    return "f" if type_of(dtype) == "float" else ""


def _expression(assign: Assign, operands: list[str]) -> str:
    name, dtype = assign.name, assign.operands[0].dtype
    integer = dtype.kind in "iu"
    if name == "convert_element_type":
        return _conversion(dtype, assign.out.dtype, operands[0])
    if name == "rem" and integer:
        return f"{operands[0]} % {operands[1]}"
    if name in _LOGICAL and dtype.kind != "b":
        raise ValueError(f"{name} of integers, bit by bit")
    if name == "select_n" and (dtype.kind != "b" or len(operands) != 3):
        raise ValueError("select_n between more than two cases")
    if name in _FORMS and not (name == "div" and integer):
        return _FORMS[name].format(*operands)
    if name not in _NAMES or integer:
        raise ValueError(f"{name} of {dtype}")
    return f"{_NAMES[name]}{_suffix(dtype)}({', '.join(operands)})"


def _conversion(old: np.dtype, new: np.dtype, x: str) -> str:
    if old.kind == "b":
        return f"{x} ? 1 : 0"
    return f"{x} != 0" if new.kind == "b" else f"({type_of(new)}){x}"


def write_function(
    fn: Callable[..., PyTree],
    arguments: Mapping[str, PyTree],
    places: Callable[[list[int]], Sequence[str]],
) -> list[str]:
    """Lines of C that compute the results of a function and assign them, or "return" them.

    **Arguments:**

    - `fn`: a function of the values of `arguments`, which returns a pytree.
    - `arguments`: pytrees by their names in C. A number `t` is named `t`; entries of a pytree `p` are `p[0]`, `p[1]`.
    - `places`: names of the results, one for each entry, from the sizes of the leaves that `fn` returns.

    **Raises:**

    - `ValueError` naming an unsupported operation or type.
    """
    symbols = {name: _symbols(name, like) for name, like in arguments.items()}

    def flat(*entries: list[Array]) -> list[Array]:
        return jtu.tree_leaves(fn(*(_filled(like, x) for like, x in zip(arguments.values(), entries, strict=True))))

    entries = [[jnp.zeros((), x.dtype) for x in own] for own in symbols.values()]
    closed, shapes = trace_in_arrays(flat, *entries)
    program, text, indent = program_of(closed, list(itertools.chain(*symbols.values()))), _BlockText(), "  "
    lines = text.block(program.block, indent)
    for to, x in zip(places([math.prod(x.shape) for x in shapes]), program.results, strict=True):
        lines.append(f"{indent}return {text.value(x)};" if to == "return" else f"{indent}{to} = {text.value(x)};")
    return lines


def unused(names: Iterable[str], lines: list[str]) -> list[str]:
    """Statements for arguments that the lines do not use, which compilers would report."""
    text = "\n".join(lines)
    return [f"  (void){name};" for name in names if not re.search(rf"\b{name}\b", text)]


def _symbols(name: str, like: PyTree) -> list[Symbol]:
    leaves = [np.asarray(leaf) for leaf in jtu.tree_leaves(like)]
    if jtu.all_leaves([like]) and leaves[0].ndim == 0:
        return [Symbol(leaves[0].dtype, name)]
    kinds = [leaf.dtype for leaf in leaves for _ in range(leaf.size)]
    return [Symbol(kind, f"{name}[{i}]") for i, kind in enumerate(kinds)]


def _filled(like: PyTree, entries: list[Array]) -> PyTree:
    """The pytree with these scalars as the entries of its arrays."""
    leaves, left = [], iter(entries)
    for leaf in jtu.tree_leaves(like):
        part = [next(left) for _ in range(np.size(leaf))]
        array = jnp.stack(part) if part else jnp.zeros(0, np.asarray(leaf).dtype)
        leaves.append(array.reshape(np.shape(leaf)) if np.ndim(leaf) else part[0])
    return jtu.tree_unflatten(jtu.tree_structure(like), leaves)


class _BlockText:
    """Writes statements and names their results."""

    def __init__(self) -> None:
        self.names: dict[Symbol, str] = {}
        self.numbers = itertools.count()

    def value(self, x: Entry) -> str:
        """A name or a literal."""
        if not isinstance(x, Symbol):
            return literal(x)
        return x.name or self.names[x]

    def new(self, symbol: Symbol) -> str:
        self.names[symbol] = f"x{next(self.numbers)}"
        return self.names[symbol]

    def block(self, block: Block, indent: str) -> list[str]:
        return [indent + line for statement in block for line in self.statement(statement)]

    def statement(self, statement: Assign | Loop | Choice) -> Iterator[str]:
        if isinstance(statement, Assign):
            value = _expression(statement, [self.value(x) for x in statement.operands])
            out = statement.out
            yield f"const {type_of(out.dtype)} {self.new(out)} = {value};"
        elif isinstance(statement, Loop):
            yield from self.loop(statement)
        else:
            yield from self.choice(statement)

    def loop(self, loop: Loop) -> Iterator[str]:
        counter = f"k{next(self.numbers)}"
        for carry in loop.carries:
            start = self.value(carry.start)
            yield f"{type_of(carry.symbol.dtype)} {self.new(carry.symbol)} = {start};"
        yield f"for (int {counter} = 0; {counter} < {loop.bound}; ++{counter}) {{"
        yield from self.block(loop.head, "  ")
        if isinstance(loop.condition, Symbol):
            yield f"  if (!{self.value(loop.condition)}) break;"
        yield from self.block(loop.body, "  ")
        # A value that is another carry is copied before that carry changes.
        changed = {carry.symbol for carry in loop.carries}
        after = []
        for carry in loop.carries:
            value = self.value(carry.after)
            if carry.after in changed:
                kept = f"x{next(self.numbers)}"
                yield f"  const {type_of(carry.symbol.dtype)} {kept} = {value};"
                value = kept
            after.append((self.names[carry.symbol], value))
        for name, value in after:
            yield f"  {name} = {value};"
        yield "}"

    def choice(self, choice: Choice) -> Iterator[str]:
        for out in choice.outs:
            yield f"{type_of(out.dtype)} {self.new(out)};"
        index, last = self.value(choice.chosen), len(choice.arms) - 1
        for i, (block, results) in enumerate(choice.arms):
            test = "" if i == last else f"if ({index} == {i}) "
            yield f"{'} else ' if i else ''}{test}{{"
            yield from self.block(block, "  ")
            for out, x in zip(choice.outs, results, strict=True):
                yield f"  {self.names[out]} = {self.value(x)};"
        yield "}"
