"""Statements on scalars as C99 and as JavaScript."""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ._program import Assign, Block, Choice, Entry, Loop, Program, Symbol

# Forms that are the same in both languages; operands are names or literals.
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
_ON_BOTH = {"sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"}
_ON_BOTH |= {"exp", "expm1", "log", "log1p", "sqrt", "cbrt", "floor", "ceil", "pow"}


class Language(NamedTuple):
    """The forms in which a language differs from the other.

    - `name`: of the language.
    - `types`: names of scalar types, by kind and size of NumPy's types; "" if declarations have none.
    - `functions`: by the operations of JAX.
    - `suffixes`: of literals and functions, by type.
    - `constant`, `variable`: keywords of declarations.
    - `specials`: booleans, infinity and NaN.
    """

    name: str
    types: dict[str, str]
    functions: dict[str, str]
    suffixes: dict[str, str]
    constant: str
    variable: str
    specials: dict[str, str]

    def type_of(self, dtype: np.dtype) -> str:
        """Name of a type.

        **Raises:**

        - `ValueError` naming an unsupported type.
        """
        kind = "i" if dtype.kind in "iu" else dtype.kind + str(8 * dtype.itemsize)
        if kind not in self.types:
            raise ValueError(f"numbers of {dtype}: {self.name} has no {dtype}")
        return self.types[kind]

    def literal(self, x: np.generic) -> str:
        """A literal with the exact value of a number."""
        if x.dtype.kind == "b":
            return self.specials["true" if x else "false"]
        if x.dtype.kind in "iu":
            return str(int(np.asarray(x)))
        value = float(np.asarray(x))
        if math.isinf(value):
            return self.specials["inf"] if value > 0 else f"-{self.specials['inf']}"
        return self.specials["nan"] if math.isnan(value) else str(x) + self.suffixes.get(self.type_of(x.dtype), "")

    def expression(self, assign: Assign, operands: list[str]) -> str:
        """An operation as an expression.

        **Raises:**

        - `ValueError` naming an unsupported operation.
        """
        name, dtype = assign.name, assign.operands[0].dtype
        integer = dtype.kind in "iu"
        if name == "convert_element_type":
            return self.conversion(dtype, assign.out.dtype, operands[0])
        if name == "rem" and (integer or "rem" not in self.functions):
            return f"{operands[0]} % {operands[1]}"
        if name in _LOGICAL and dtype.kind != "b":
            raise ValueError(f"{name} of integers, bit by bit")
        if name == "select_n" and (dtype.kind != "b" or len(operands) != 3):
            raise ValueError("select_n between more than two cases")
        if name in _FORMS and not (name == "div" and integer):
            return _FORMS[name].format(*operands)
        if name not in self.functions or integer:
            raise ValueError(f"{name} of {dtype}")
        return f"{self.functions[name]}{self.suffixes.get(self.type_of(dtype), '')}({', '.join(operands)})"

    def conversion(self, old: np.dtype, new: np.dtype, x: str) -> str:
        """A number converted to another type."""
        if old.kind == "b":
            return f"{x} ? 1 : 0"
        if new.kind == "b":
            return f"{x} != 0"
        if old.kind == "f" and new.kind in "iu":
            return f"({self.type_of(new)}){x}" if self.type_of(new) else f"Math.trunc({x})"
        return f"({self.type_of(new)}){x}" if self.type_of(new) else x

    def declared(self, word: str, dtype: np.dtype, name: str) -> str:
        """Declaration of a name, up to its value."""
        return " ".join(part for part in (word, self.type_of(dtype), name) if part)


C = Language(
    "C99",
    {"f64": "double", "f32": "float", "i": "int", "b8": "int"},
    {name: name for name in (*_ON_BOTH, "exp2", "erf", "erfc")} | {"abs": "fabs", "rem": "fmod", "round": "rint"},
    {"float": "f"},
    "const",
    "",
    {"true": "1", "false": "0", "inf": "INFINITY", "nan": "NAN"},
)
JAVASCRIPT = Language(
    "JavaScript",
    {"f64": "", "i": "", "b8": ""},
    {name: f"Math.{name}" for name in (*_ON_BOTH, "abs")},
    {},
    "const",
    "let",
    {"true": "true", "false": "false", "inf": "Infinity", "nan": "NaN"},
)


def write_program(program: Program, outputs: list[str], language: Language, indent: str) -> list[str]:
    """Lines of code that compute the results of a program and assign them to `outputs`, or "return" them.

    **Raises:**

    - `ValueError` naming an unsupported operation or type.
    """
    text = _BlockText(language)
    lines = text.block(program.block, indent)
    for to, x in zip(outputs, program.results, strict=True):
        lines.append(f"{indent}return {text.value(x)};" if to == "return" else f"{indent}{to} = {text.value(x)};")
    return lines


class _BlockText:
    """Writes statements and names their results."""

    def __init__(self, language: Language) -> None:
        self.language = language
        self.names: dict[Symbol, str] = {}
        self.numbers = itertools.count()

    def value(self, x: Entry) -> str:
        """A name or a literal."""
        if not isinstance(x, Symbol):
            return self.language.literal(x)
        return x.name or self.names[x]

    def new(self, symbol: Symbol) -> str:
        self.names[symbol] = f"x{next(self.numbers)}"
        return self.names[symbol]

    def block(self, block: Block, indent: str) -> list[str]:
        return [indent + line for statement in block for line in self.statement(statement)]

    def statement(self, statement: Assign | Loop | Choice) -> Iterator[str]:
        if isinstance(statement, Assign):
            value = self.language.expression(statement, [self.value(x) for x in statement.operands])
            out = statement.out
            yield f"{self.language.declared(self.language.constant, out.dtype, self.new(out))} = {value};"
        elif isinstance(statement, Loop):
            yield from self.loop(statement)
        else:
            yield from self.choice(statement)

    def loop(self, loop: Loop) -> Iterator[str]:
        word, counter = self.language.variable, f"k{next(self.numbers)}"
        for carry in loop.carries:
            start = self.value(carry.start)
            yield f"{self.language.declared(word, carry.symbol.dtype, self.new(carry.symbol))} = {start};"
        declared = self.language.declared(word, np.dtype(int), counter)
        yield f"for ({declared} = 0; {counter} < {loop.bound}; ++{counter}) {{"
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
                yield f"  {self.language.declared(self.language.constant, carry.symbol.dtype, kept)} = {value};"
                value = kept
            after.append((self.names[carry.symbol], value))
        for name, value in after:
            yield f"  {name} = {value};"
        yield "}"

    def choice(self, choice: Choice) -> Iterator[str]:
        for out in choice.outs:
            yield f"{self.language.declared(self.language.variable, out.dtype, self.new(out))};"
        index, last = self.value(choice.chosen), len(choice.arms) - 1
        for i, (block, results) in enumerate(choice.arms):
            test = "" if i == last else f"if ({index} == {i}) "
            yield f"{'} else ' if i else ''}{test}{{"
            yield from self.block(block, "  ")
            for out, x in zip(choice.outs, results, strict=True):
                yield f"  {self.names[out]} = {self.value(x)};"
        yield "}"
