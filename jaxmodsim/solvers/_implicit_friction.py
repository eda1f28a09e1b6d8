"""ImplicitFriction: fixed steps that are stable for friction of any stiffness, as a diffrax solver."""

from collections.abc import Callable
from typing import ClassVar, cast

import diffrax as dfx
from jaxtyping import Array, PyTree

from .._core.arrays import Real


class ImplicitFriction(dfx.AbstractSolver):
    """Fixed steps that are implicit in friction alone, and stable for friction of any stiffness.

    Use it for steps that a control loop or the sampling of a record prescribes:
    `simulate(..., dt=1e-3, solver=ImplicitFriction())`. A step from t to t + h evaluates masses, directions, loads and
    all other forces at t, and friction at t + h. The state of the law moves by its own solution at constant slip
    velocity. The slip velocities solve `v = v_free - h D M^-1 D^T F(v)`, by a bracketing search that always ends.
    Coordinates follow with the new velocities (semi-implicit Euler). A bristle's deflection stays within its limit, and
    velocities in stick go to zero, for any step and stiffness, in float32 and float64. Bristles that a step does not
    resolve cost no accuracy: their damping acts by its impulse over the step.

    The order is 1, without an error estimate. Steps must resolve the fast motion of the mechanism itself: springs of
    angular frequency w need `h w < 2`. Friction may be any law with a state of its own, or a function of slip velocity
    (`Viscous`, `Regularized` of any width, your own function), along displacements or in the plane, within
    constraints. Set-valued laws, and loads that are reactions of constraints, are not supported. If a step is so long
    that stick and slip are both solutions, as with the Stribeck effect, it takes the one near the motion before.

    Newton steps with a line search solve for several elements, or for slip in the plane. Equations that they do not
    solve (rare: in float32, coupled planar contacts whose deflection a step passes 10^7 times) end the run with
    `diffrax.RESULTS.nonlinear_divergence`.

    `run.forces` gives the law's force at the saved state; between steps states are interpolated linearly. Derivatives,
    forward and reverse, are those of the exact step by the implicit function theorem.

    **Arguments:**

    - `advance`: `advance(t0, t1, y, args)` -> `(y1, solved)`, the step itself, which `jaxmodsim.simulate` sets.

    **Raises:**

    - `ValueError` (at the run) outside `jaxmodsim.simulate`, without `dt`, and for friction or contacts that it does
      not support.

    **Example:**

    ```python
    scene = jms.problems.ramped_box.scene(jms.problems.ramped_box.lugre())
    run = jms.simulate(scene, [0.0], [0.0], 3.0, dt=0.01, solver=jms.ImplicitFriction())
    print(f"{run.qd[-1, 0]:.3f} m/s after {run.stats['num_steps']} steps")
    ```

    ```text
    0.461 m/s after 300 steps
    ```

    ??? cite "Reference"

        Steps that find velocities and forces of friction together:

        ```bibtex
        @article{moreau1999numerical,
            author={Moreau, Jean Jacques},
            title={Numerical aspects of the sweeping process},
            journal={Computer Methods in Applied Mechanics and Engineering},
            volume={177}, number={3--4}, pages={329--349}, year={1999},
        }
        ```
    """

    advance: Callable[..., tuple[PyTree, Array]] | None = None
    term_structure: ClassVar = dfx.ODETerm
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    def order(self, terms: PyTree) -> int:
        """Order of the solution."""
        del terms
        return 1

    def init(self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree) -> None:
        """No memory from step to step."""

    def func(self, terms: PyTree, t0: Real, y0: PyTree, args: PyTree) -> PyTree:
        """The vector field."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree, solver_state: None, made_jump: Real
    ) -> tuple[PyTree, None, dict[str, PyTree], None, dfx.RESULTS]:
        """One step."""
        del terms, solver_state, made_jump
        if self.advance is None:
            raise ValueError("ImplicitFriction must know which forces are friction: use it in jaxmodsim.simulate.")
        y1, solved = self.advance(t0, t1, y0, args)
        failure = cast(dfx.RESULTS, dfx.RESULTS.nonlinear_divergence)
        result = dfx.RESULTS.where(solved, dfx.RESULTS.successful, failure)
        return y1, None, {"y0": y0, "y1": y1}, None, result
