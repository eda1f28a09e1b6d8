"""Gauss: symplectic collocation with fixed steps, as a diffrax solver."""

from typing import ClassVar, cast

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PyTree

from .._core.arrays import Real
from ._collocation import CollocationMemory, collocation_start, collocation_step
from ._equation import check_floating, check_ode, in_own_time
from ._state_layout import PolynomialInterpolation


class Gauss(dfx.AbstractSolver):
    """Gauss-Legendre collocation with fixed steps, for long runs that preserve the structure of mechanics.

    An implicit Runge-Kutta method of order `2 stages` (one stage: the implicit midpoint rule). It is symplectic and
    symmetric: on canonical equations in (q, p) energy does not drift but stays within the method's error, and
    quadratic invariants (angular momentum, the energy of linear systems) hold to rounding. On other
    equations it is an accurate method without damping.

    It works in `diffrax.diffeqsolve` with an `ODETerm` and constant steps, forward and backward in time, on any
    pytree of real floating arrays, in float32 and float64. Adaptive steps would destroy the structure: there is no
    error estimate, and diffrax's adaptive controllers refuse the method. Dense output has the order of the method.

    Fixed-point iteration solves the stages to rounding, with about 12 to 18 evaluations of each stage at 20 steps per
    period. Its limit is stiffness: `dt` times the fastest rate must stay below about 1, 1.5, 2 for 1, 2, 3 stages.
    A step whose iteration does not converge within 50 evaluations ends the run with
    `diffrax.RESULTS.nonlinear_divergence` and NaN.

    Derivatives, forward and reverse, are those of the exact stages by the implicit function theorem. The solver's state
    carries the rounding of the sum of steps (compensated summation), which has no derivative.

    **Arguments:**

    - `stages`: 1, 2 or 3.

    **Raises:**

    - `ValueError` for another number of stages, and (while tracing) for complex or integer states, and for
      terms other than an `ODETerm`.

    **Example:**

    ```python
    pendulum = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])]))  # angle, momentum
    solution = diffrax.diffeqsolve(pendulum, jms.Gauss(3), 0.0, 100.0, 0.1, jnp.array([1.0, 0.0]))
    q, p = solution.ys[-1]
    print(abs(0.5 * p**2 - jnp.cos(q) + jnp.cos(1.0)) < 1e-8)  # change of the energy
    ```

    ```text
    True
    ```

    ??? cite "Reference"

        Collocation: section II.1.3; symplecticity and quadratic invariants: IV.2 and VI.4; rounding: VIII.5.

        ```bibtex
        @book{hairer2006geometric,
            author={Hairer, Ernst and Lubich, Christian and Wanner, Gerhard},
            title={Geometric Numerical Integration: Structure-Preserving Algorithms for Ordinary Differential
                   Equations},
            publisher={Springer}, edition={second}, year={2006},
        }
        ```
    """

    stages: int = eqx.field(default=3, static=True)
    # Not `ODETerm`: `diffrax.BacksolveAdjoint` solves its adjoint equation, a term of another class.
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = PolynomialInterpolation

    def __check_init__(self) -> None:
        if isinstance(self.stages, bool) or self.stages not in (1, 2, 3):
            raise ValueError(f"Gauss has 1, 2 or 3 stages, but stages = {self.stages!r} was given.")

    def order(self, terms: PyTree) -> int:
        """Order of the solution: twice the number of stages."""
        del terms
        return 2 * self.stages

    def init(self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree) -> CollocationMemory:
        """Memory for the first step; refuses terms and states of a wrong type."""
        check_ode(terms, method="Gauss")
        check_floating(y0, method="Gauss")
        field, start, _ = in_own_time(terms, t0, t1, args)
        return collocation_start(self.stages, field, start, y0)

    def func(self, terms: PyTree, t0: Real, y0: PyTree, args: PyTree) -> PyTree:
        """The vector field."""
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: PyTree,
        t0: Real,
        t1: Real,
        y0: PyTree,
        args: PyTree,
        solver_state: CollocationMemory,
        made_jump: Real,
    ) -> tuple[PyTree, None, dict[str, PyTree], CollocationMemory, dfx.RESULTS]:
        """One step; see `collocation_step`."""
        rest = [jnp.where(made_jump, 0.0, x) for x in solver_state.rest]
        field, start, length = in_own_time(terms, t0, t1, args)
        step = collocation_step(self.stages, field, start, length, y0, solver_state._replace(rest=rest))
        failure = cast(dfx.RESULTS, dfx.RESULTS.nonlinear_divergence)
        result = dfx.RESULTS.where(step.solved, dfx.RESULTS.successful, failure)
        return step.y1, None, {"y0": y0, "y1": step.y1, "k": step.dense}, step.memory, result
