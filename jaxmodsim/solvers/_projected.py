"""A solver wrapper that gives each step its own arguments, and projects the state after each step."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._core.arrays import Real
from ._wrapper import AbstractSolverWrapper

# Rounding units in time.
_ROUNDING = 4.0


class Projected(AbstractSolverWrapper):
    """Wrap a diffrax solver so that every step ends with a projection, or has arguments of its own.

    The order is that of the wrapped solver, as a projection removes at most the error of the step. Dense output inside
    a step is that of the wrapped solver, not projected.

    **Arguments:**

    - `solver`: any solver of an `ODETerm`.
    - `project`: `project(t, y, args)` -> `y`; None for no projection.
    - `freeze_args`: `freeze_args(t0, args)` -> `args` of a step that begins at t0; None for the `args` of the run.
    """

    term_structure: ClassVar = dfx.ODETerm
    solver: dfx.AbstractSolver  # pyright: ignore[reportIncompatibleVariableOverride]
    project: Callable[..., PyTree] | None
    freeze_args: Callable[..., PyTree] | None = None

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Interpolation of the wrapped solver."""
        return self.solver.interpolation_cls

    def func(self, terms: PyTree, t0: Real, y0: PyTree, args: PyTree) -> PyTree:
        """The vector field."""
        return self.solver.func(terms, t0, y0, args)

    def init(self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree) -> PyTree:
        """State of the wrapped solver."""
        return self.solver.init(terms, t0, t1, y0, args)

    def step(
        self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Real
    ) -> tuple[PyTree, PyTree, dict[str, PyTree], PyTree, dfx.RESULTS]:
        """A step of the wrapped solver, projected."""
        args = args if self.freeze_args is None else self.freeze_args(t0, args)
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        if self.project is not None:
            y1, error = projected(y0, y1, error, self.project(t1, y1, args), (t0, t1))
        return y1, error, dense, state, result


def projected(
    y0: PyTree, y: PyTree, error: PyTree | None, there: PyTree, times: tuple[Real, Real]
) -> tuple[PyTree, PyTree | None]:
    """The end of a step after its projection, and the error estimate, at least as large as the projection.

    A projection removes an error of the step. The step was too long if the projection is larger than the estimate, as
    near a singular configuration, where constraints determine some velocities by rounding alone. It is not if the
    state moves as far within the rounding of time: constraints that move cannot be resolved further.

    **Arguments:**

    - `y0`: start of the step.
    - `y`, `error`: end of the step, and its error estimate, of the same structure; None for a method without one.
    - `there`: the end after the projection.
    - `times`: start and end.
    """
    if error is None:
        return there, None
    t0, t1 = (jax.lax.stop_gradient(jnp.asarray(t)) for t in times)
    kind = jnp.finfo(t1.dtype)
    part = _ROUNDING * float(kind.eps) * jnp.abs(t1) / jnp.maximum(t1 - t0, float(kind.tiny))

    def size(error: Array, start: Array, a: Array, b: Array) -> Array:
        moves = jax.lax.stop_gradient(jnp.minimum(part, 1.0) * jnp.abs(a - start))
        return jnp.maximum(jnp.abs(error), jnp.abs(a - b) - moves)

    return there, jtu.tree_map(size, error, y0, there, y)
