"""Step functions of time in functions of the user, by whose switching times JAX gives no derivative."""

import logging
from collections.abc import Iterable, Sequence
from functools import cache

import jax.numpy as jnp

from .compat import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

_LOG = logging.getLogger("jaxmodsim")
# Primitives whose value jumps, or that tell a jump where to be.
_JUMPS = {"lt", "le", "gt", "ge", "sign", "floor", "ceil", "round"}
# Functions of jax.numpy that compare their arguments, and are continuous.
_CONTINUOUS = {"clip", "_interp", "interp"}


def remark_on_steps(closed: ClosedJaxpr, names: Sequence[str], name: str) -> None:
    """Log once for each function that it compares the time with numbers of `params`.

    **Arguments:**

    - `closed`: the traced function.
    - `names`: of its arguments, such as "t" and "params['ts']".
    - `name`: of the function, for the message.
    """
    if "t" not in names:
        return
    switching: set[str] = set()
    _sources(closed.jaxpr, [frozenset([x]) for x in names], switching)
    if switching:
        _remark(name, ", ".join(sorted(switching)))


@cache
def _remark(name: str, numbers: str) -> None:
    _LOG.warning(
        "In %s a comparison, such as jnp.where(t > ts, a, b), depends on t and on %s. If the value jumps there, JAX"
        " gives a derivative of zero by the switching time. Make the jump an event:"
        " jaxmodsim.Switch(lambda t, q, qd, p: t - p['ts'], above=a, below=b), or a Signal for a sampled input.",
        name,
        numbers,
    )


def _sources(jaxpr: Jaxpr, inputs: Iterable[frozenset[str]], switching: set[str]) -> list[frozenset[str]]:
    """Arguments that each result is computed from; `switching` collects the `params` in comparisons with the time."""
    known: dict[object, frozenset[str]] = dict(zip(jaxpr.invars, inputs, strict=True))

    def of(x: object) -> frozenset[str]:
        return frozenset() if isinstance(x, Literal) else known.get(x, frozenset())

    for eqn in jaxpr.eqns:
        given = [of(x) for x in eqn.invars]
        everything: frozenset[str] = frozenset().union(*given)
        numbers = {x for x in everything if x.startswith("params")}
        real = any(jnp.issubdtype(getattr(x.aval, "dtype", bool), jnp.floating) for x in eqn.invars)
        if eqn.primitive.name in _JUMPS and real and "t" in everything:
            switching |= numbers
        results = [everything] * len(eqn.outvars)
        if eqn.params.get("name") not in _CONTINUOUS:
            for body in _bodies(eqn):
                same = len(body.invars) == len(given)
                inner = _sources(body, given if same else [everything] * len(body.invars), switching)
                results = inner if same and len(inner) == len(results) else results
        known.update(zip(eqn.outvars, results, strict=True))
    return [of(x) for x in jaxpr.outvars]


def _bodies(eqn: JaxprEqn) -> list[Jaxpr]:
    """Functions inside an equation."""
    values = [x for value in eqn.params.values() for x in (value if isinstance(value, tuple | list) else (value,))]
    return [x.jaxpr if isinstance(x, ClosedJaxpr) else x for x in values if isinstance(x, ClosedJaxpr | Jaxpr)]
