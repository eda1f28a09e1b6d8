"""The equation in the terms that diffrax passes to a solver, in its own time."""

from collections.abc import Callable

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._core.arrays import Real


def check_ode(terms: PyTree, *, method: str) -> None:
    """Refuse all terms other than those of an ordinary differential equation.

    **Raises:**

    - `ValueError` naming `method` and the term.
    """
    inner = terms
    # diffrax wraps a term in one that knows the direction of time, and for `BacksolveAdjoint` in the adjoint equation.
    while not isinstance(inner, dfx.ODETerm) and isinstance(getattr(inner, "term", None), dfx.AbstractTerm):
        inner = inner.term
    if not isinstance(inner, dfx.ODETerm):
        raise ValueError(
            f"{method} solves ordinary differential equations, but a {type(inner).__name__} was given. Pass a"
            " diffrax.ODETerm, or take one of diffrax's solvers for such terms."
        )


def check_floating(y0: PyTree, *, method: str) -> None:
    """Refuse complex and integer states.

    **Raises:**

    - `ValueError` naming `method` and the type.
    """
    for leaf in jtu.tree_leaves(y0):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"{method} needs a state of real floating numbers, but one of its arrays has the type"
                f" {jnp.result_type(leaf)}. Split complex numbers into real and imaginary parts."
            )


def in_own_time(
    terms: PyTree, t0: Real, t1: Real, args: PyTree
) -> tuple[Callable[[Array, PyTree], PyTree], Array, Array]:
    """Vector field, start and length of a step in the time of the equation, which may run backward.

    diffrax always steps forward: if t1 < t0, through negative times, with a field that is not negated. The control of
    its terms has the direction.
    """
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    direction = jnp.asarray(terms.contr(jnp.zeros_like(t0), jnp.ones_like(t0)), t0.dtype)
    return lambda t, y: terms.vf(direction * t, y, args), direction * t0, direction * (t1 - t0)
