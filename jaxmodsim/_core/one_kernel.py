"""Compilation of a function as one kernel of XLA on CPU."""

import math
import re
from collections.abc import Callable, Iterator
from functools import partial, reduce
from typing import Any, TypeVar

import jax

from .compat import AVAILABLE, Primitive, ad, batching, ir, mlir
from .compat import stablehlo as hlo

_Tree = TypeVar("_Tree")
# A kernel runs on one core, and its arrays should fit into the cache of that core.
_MOST_AT_ONCE = 64
# Largest numbers of entries of the first factor times those of the product, of terms of a sum, of entries otherwise.
_MOST_PRODUCTS, _MOST_TERMS, _MOST_ENTRIES = 256, 1000, 100_000
# Largest number of entries of a loop state. A kernel has one buffer for all its values, and the system allocates a
# buffer above 32 MB at every call. Gradient of the belt oscillator with memory for 200 000 steps 4.8 ms, for 262 144
# steps 20 ms; in several kernels 3 ms.
_MOST_CARRIED = 4_000_000
# Operations that XLA can emit in one function. Others need the services of a run: LAPACK, callbacks, threads.
_HOLDS = frozenset(
    """
    abs add and atan2 bitcast_convert broadcast_in_dim case cbrt ceil clamp compare concatenate constant convert cosine
    divide dot_general dynamic_slice dynamic_update_slice exponential exponential_minus_one floor gather if iota
    is_finite log log_plus_one logistic maximum minimum multiply negate not one_scatter optimization_barrier or pad
    popcnt power reduce remainder reshape return reverse round_nearest_afz round_nearest_even rsqrt select shift_left
    shift_right_arithmetic shift_right_logical sign sine slice sqrt subtract tan tanh transpose while xor
    chlo.acos chlo.acosh chlo.asin chlo.asinh chlo.atan chlo.atanh chlo.cosh chlo.erf chlo.erf_inv chlo.erfc chlo.is_inf
    chlo.is_neg_inf chlo.is_pos_inf chlo.lgamma chlo.next_after chlo.sinh chlo.square chlo.tan
    """.split()  # noqa: SIM905 - a list has a line for each
)
# Operations that create or move buffers, of any size.
_MOVES = {"broadcast_in_dim", "case", "constant", "dynamic_slice", "dynamic_update_slice", "if", "reshape"}


def in_one_kernel(function: Callable[..., _Tree], *args: Any) -> _Tree:
    """Evaluate `function(*args)` in one kernel on CPU, and each of its derivatives in another.

    XLA on CPU compiles a separate kernel for every few operations, and calls one after another. A call takes 0.1 us,
    far more than the arithmetic of a mechanical system. A call with the attribute `xla_cpu_small_call`, which XLA gives
    to small loops, becomes one kernel, loops included. The function has no effect on other platforms, with more than 64
    runs in a batch, and for operations that such a kernel does not support.

    **Arguments:**

    - `function`: a function of `jax.jit`.
    - `args`: pytrees of arrays.
    """
    if "kernels" not in AVAILABLE:
        return function(*args)
    args = jax.tree.map(partial(_mark.bind, result=False, runs=1), args)
    return jax.tree.map(partial(_mark.bind, result=True, runs=1), function(*args))


def _marker() -> Any:
    """An identity on the arguments and results of the call.

    Its lowering inspects the call that computes a value. The results of a derivative in reverse mode are the cotangents
    of the arguments. A tangent carries its value, so that JAX keeps the mark of the run even if only the derivative is
    used.
    """
    mark = Primitive("mark_one_kernel")
    mark.def_impl(lambda x, *_, **__: x)
    mark.def_abstract_eval(lambda x, *_, **__: x)
    ad.primitive_jvps[mark] = _jvp
    ad.primitive_transposes[mark] = _transpose
    batching.primitive_batchers[mark] = _batch
    mlir.register_lowering(mark, lambda _, x, *__, **___: [x])
    mlir.register_lowering(mark, _lower, platform="cpu", cacheable=False)
    return mark


def _jvp(primals: Any, tangents: Any, **marks: Any) -> tuple[Any, Any]:
    value, tangent = _mark.bind(*primals, **marks), tangents[0]
    return value, tangent if isinstance(tangent, ad.Zero) else _mark.bind(tangent, value, **marks)


def _transpose(cotangent: Any, *operands: Any, result: bool, runs: int) -> list[Any]:
    if not isinstance(cotangent, ad.Zero):
        cotangent = _mark.bind(cotangent, *operands[1:], result=not result, runs=runs)
    return [cotangent] + [None] * len(operands[1:])


def _batch(operands: Any, axes: Any, *, result: bool, runs: int) -> tuple[Any, Any]:
    size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
    return _mark.bind(*operands, result=result, runs=runs * size), axes[0]


def _lower(ctx: Any, x: Any, *_: Any, result: bool, runs: int) -> list[Any]:
    call = getattr(x.owner, "operation", None)  # the owner of an argument is a block without operation
    alone = getattr(ctx.module_context.axis_context, "num_devices", None) in (None, 1)
    if result and runs <= _MOST_AT_ONCE and alone and call is not None and call.name == "func.call":
        _mark_call(ctx, call)
    return [x]


def _mark_call(ctx: Any, call: Any) -> None:
    """Set the attribute of the call, and call a copy of the function that uses all its arguments."""
    functions = ctx.module_context.symbol_table
    function = functions[_callee(call)].operation
    block = function.regions[0].blocks[0]
    if "mhlo.frontend_attributes" in call.attributes:
        return  # already marked by another result
    ending = block.operations[len(block.operations) - 1].operation
    inputs, results = ([x for x in values if _size(x)] for values in (block.arguments, ending.operands))
    if not inputs or not results or any(isinstance(x.type.element_type, ir.ComplexType) for x in [*inputs, *results]):
        return
    if not all(kind in _HOLDS for kind in _operations(functions, function, set())):
        return
    with ir.InsertionPoint(call):
        # Without a barrier XLA substitutes a constant argument inside the function, which then leaves it unused.
        for i, x in enumerate(call.operands):
            call.operands[i] = hlo.optimization_barrier([x])
    with ir.InsertionPoint(function):
        own = function.clone()
    call.attributes["callee"] = ir.FlatSymbolRefAttr.get(functions.insert(own).value)
    marks = {"xla_cpu_small_call": "true", "inlineable": "false"}
    attributes: dict[str, ir.Attribute] = {name: ir.StringAttr.get(value) for name, value in marks.items()}
    call.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(attributes)
    block = own.regions[0].blocks[0]
    ending = block.operations[len(block.operations) - 1].operation
    # Empty arrays are not computed.
    smallest = min((i for i, x in enumerate(ending.operands) if _size(x)), key=lambda i: _size(ending.operands[i]))
    with ir.InsertionPoint(ending):
        ending.operands[smallest] = _needing(ending.operands[smallest], [x for x in block.arguments if _size(x)])


def _needing(x: Any, all_of: list[Any]) -> Any:
    """`x`, computed with all other arguments: XLA ends the process if such a call has an unused argument.

    For any integer n the product n (n + 1) is even. Its last bit is zero and changes no bit of `x`, but XLA does not
    know that.
    """
    number = reduce(hlo.add, map(_any_number, all_of))
    number_type = ir.RankedTensorType.get([], ir.IntegerType.get_signless(32))
    one = hlo.constant(ir.DenseElementsAttr.get_splat(number_type, ir.IntegerAttr.get(number_type.element_type, 1)))
    nothing = hlo.and_(hlo.multiply(number, hlo.add(number, one)), one)
    bits = _bits(x)
    nothing = hlo.convert(ir.RankedTensorType.get([], bits.type.element_type), nothing)
    changed = hlo.xor(bits, hlo.broadcast_in_dim(bits.type, nothing, mlir.dense_int_array([])))
    return changed if changed.type == x.type else hlo.bitcast_convert(x.type, changed)


def _bits(x: Any) -> Any:
    """`x` as integers."""
    shape, element = x.type.shape, x.type.element_type
    if isinstance(element, ir.IntegerType):
        return x
    return hlo.bitcast_convert(ir.RankedTensorType.get(shape, ir.IntegerType.get_signless(element.width)), x)


def _any_number(x: Any) -> Any:
    """An integer from the first entry."""
    lowest, highest, steps = (mlir.dense_int_array([n] * len(x.type.shape)) for n in (0, 1, 1))
    entry = hlo.slice(x, lowest, highest, steps)
    entry = _bits(hlo.reshape(ir.RankedTensorType.get([], x.type.element_type), entry))
    return hlo.convert(ir.RankedTensorType.get([], ir.IntegerType.get_signless(32)), entry)


def _size(array: Any) -> int:
    return math.prod(array.type.shape)


def _callee(call: Any) -> str:
    return ir.FlatSymbolRefAttr(call.attributes["callee"]).value


def _operations(functions: Any, function: Any, seen: set[str]) -> Iterator[str]:
    """Kinds of the operations in a function and in the functions that it calls."""
    todo = [function]
    while todo:
        for region in todo.pop().regions:
            for block in region.blocks:
                for each in block.operations:
                    operation = each.operation
                    if operation.name == "func.call" and _callee(operation) not in seen:
                        seen.add(_callee(operation))
                        yield from _operations(functions, functions[_callee(operation)].operation, seen)
                    elif not operation.name.startswith("func."):
                        yield _kind(operation)
                        todo.append(operation)


def _kind(operation: Any) -> str:
    """Name of an operation without its dialect; a name outside `_HOLDS` if the operation is too large for the kernel.

    XLA uses a library for matrix products from 8 x 8 on and for sums of many terms, and several cores for large arrays.
    A scatter to one index is a write of a slice.
    """
    kind, operands = operation.name.removeprefix("stablehlo."), operation.operands
    size = max((math.prod(x.type.shape) for x in operation.results), default=0)
    if kind == "scatter":
        indices = operands[(len(operands) - 1) // 2].type.shape
        places = re.search(r"index_vector_dim = (\d+)", str(operation.attributes["scatter_dimension_numbers"]))
        vector = int(places[1]) if places else 0
        return "one_scatter" if math.prod(n for i, n in enumerate(indices) if i != vector) == 1 else kind
    if kind == "dot_general":
        fits = size * math.prod(operands[0].type.shape) <= _MOST_PRODUCTS
    elif kind == "while":
        fits = sum(math.prod(x.type.shape) for x in operation.results) <= _MOST_CARRIED
    elif kind == "reduce":
        fits = math.prod(operands[0].type.shape) <= _MOST_TERMS
    else:
        fits = kind in _MOVES or size <= _MOST_ENTRIES
    return kind if fits else f"large {kind}"


_mark: Any = _marker() if "kernels" in AVAILABLE else None
