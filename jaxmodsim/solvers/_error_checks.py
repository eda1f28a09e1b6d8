"""Traced functions of diffrax without what costs time: checks of their arguments, and a hundred steps of rounding."""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array

from .._core.compat import AVAILABLE, ClosedJaxpr, Jaxpr, JaxprEqn, Literal


def without_error_checks(fn: Callable[..., Any], *args: Array | None) -> Any:
    """`fn(*args)` without the checks by `equinox.error_if` of the arguments themselves.

    Such a check calls back to Python if it fails. JAX does not keep a program with a callback in its persistent
    compilation cache, and inside `jax.vmap` one failed check ends the whole batch. The caller therefore makes the same
    checks, and returns their results as numbers.

    This leaves out only checks that return one of `args`, a copy or a multiple of it (times that run backward). Checks
    of other values stay, and so do all checks in loops and in functions with a derivative of their own. Derivatives are
    those of `fn`, as a check is an identity.

    **Arguments:**

    - `fn`: a function of arrays that returns a pytree of arrays. It may close over traced values.
    - `args`: arrays, or None. If none of them is traced, nothing is compiled, and this calls `fn` itself.

    **Returns:**

    The result of `fn`.
    """
    if "jaxprs" not in AVAILABLE or not any(isinstance(x, jax.core.Tracer) for x in args):
        return fn(*args)
    closed, shapes = jax.make_jaxpr(fn, return_shape=True)(*args)
    given = jtu.tree_leaves(args)
    return jtu.tree_unflatten(jtu.tree_structure(shapes), _run(closed, given, list(given)))


def _run(closed: ClosedJaxpr, inputs: list[Any], given: list[Any]) -> list[Any]:
    """Evaluate a traced function without the checks of the values `given`, to which this adds their multiples."""
    jaxpr = closed.jaxpr
    values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *inputs], strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        operands = [read(x) for x in eqn.invars]
        values.update(zip(eqn.outvars, _step(eqn, operands, given), strict=True))
    return [read(x) for x in jaxpr.outvars]


def _step(eqn: Any, operands: list[Any], given: list[Any]) -> list[Any]:
    """Outputs of one equation."""
    name = eqn.primitive.name
    if name == "jit" and calls_back(eqn.params["jaxpr"].jaxpr):
        return _run(eqn.params["jaxpr"], operands, given)
    own = [any(x is each for each in given) for x in operands]
    checks = name == "custom_jvp_call" and len(eqn.outvars) == 1 and calls_back(eqn.params["call_jaxpr"].jaxpr)
    if checks and own[0]:
        return operands[:1]
    bound = eqn.primitive.get_bind_params(eqn.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    out = eqn.primitive.bind(*functions, *operands, **params)
    out = list(out) if eqn.primitive.multiple_results else [out]
    if name in ("copy", "mul") and any(own):
        given += out
    return out


def calls_back(jaxpr: Any) -> bool:
    """Whether a traced function calls Python while it runs."""
    return any("callback" in eqn.primitive.name or any(map(calls_back, _inner(eqn))) for eqn in jaxpr.eqns)


def _inner(eqn: Any) -> list[Any]:
    """Traced functions inside an equation: bodies, branches, and functions with a derivative of their own."""
    inside = [x for value in eqn.params.values() for x in (value if isinstance(value, tuple | list) else (value,))]
    return [getattr(x, "jaxpr", x) for x in inside if hasattr(getattr(x, "jaxpr", x), "eqns")]


def without_single_roundings(jaxpr: Jaxpr) -> Jaxpr:
    """The traced loop of diffrax, with the calls by which it steps back from t1, one rounding at a time, as one step.

    It steps on to t1 from any time up to 100 roundings before. These calls were 394 of 2638 equations of LuGre's box,
    and a sixth of the time in which it compiles.
    """
    if "jaxprs" not in AVAILABLE:
        return jaxpr
    calls: list[JaxprEqn] = []
    for eqn in jaxpr.eqns:
        if any(x.primitive.name == "nextafter" for function in _inner(eqn) for x in function.eqns):
            calls = [*calls, eqn] if calls and eqn.invars == calls[-1].outvars else [eqn]
    if len(calls) < 3:
        return jaxpr
    # The first one stays: before zero it is the largest negative number that is not subnormal.
    first, *others = calls
    step = jax.jit(lambda t: _before(t, len(others)))
    (one,) = jax.make_jaxpr(step)(first.outvars[0].aval).jaxpr.eqns
    one = one.replace(invars=first.outvars, outvars=others[-1].outvars)
    kept = [one if eqn is others[-1] else eqn for eqn in jaxpr.eqns if not any(eqn is x for x in others[:-1])]
    return jaxpr.replace(eqns=kept)


def _before(t: Array, roundings: int) -> Array:
    """The number so many roundings before `t`, which is not within them from zero: the bits of numbers are in order."""
    bits = lax.bitcast_convert_type(t, jnp.dtype(f"int{8 * t.dtype.itemsize}"))
    return lax.bitcast_convert_type(bits + jnp.where(t > 0, -roundings, roundings).astype(bits.dtype), t.dtype)
