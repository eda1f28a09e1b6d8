"""Projection of an initial state onto the constraints."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._core.arguments import check_real
from .._core.cholesky import factor_positive_definite, solve_balanced
from ..mechanics import errors, motion_equations, rates
from ..scene import Scene, State, check_scene
from ._outcome import SimulationError

# Steps of Newton's method: far more than a convergent iteration needs.
_STEPS = 50


def project_initial_state(
    scene: Scene,
    q0: ArrayLike | list[float],
    qd0: ArrayLike | list[float],
    *,
    t0: ArrayLike = 0.0,
    hold: Sequence[int] = (),
) -> tuple[Float[Array, " dof"], Float[Array, " dof"]]:
    """Project a state onto the constraints of a scene.

    Newton's method changes the position by the least amount in the metric of the mass matrix; then the smallest
    impulses change the velocities.

    **Arguments:**

    - `scene`: the `Scene`.
    - `q0`, `qd0`: approximate position and velocity, shape `[dof]`.
    - `t0`: time [s], for constraints that move.
    - `hold`: indices of the coordinates that keep their position and velocity (the angle of a crank).

    **Returns:**

    `(q0, qd0)`, for `simulate`.

    **Raises:**

    - `SimulationError` if there is no such state near q0 and qd0: the constraints exclude it (a linkage that does not
      close), or `hold` leaves no freedom.
    - `ValueError` for wrong shapes and indices.

    **Example:**

    ```python
    rod = jms.Constraint(lambda t, q, p: jnp.hypot(q[0], q[1]) - 1.0)
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2), constraints=(rod,))
    q0, qd0 = jms.project_initial_state(scene, [0.6, -0.9], [1.0, 0.0], hold=(0,))
    print(q0.round(6), qd0.round(6))
    ```

    ```text
    [ 0.6 -0.8] [1.   0.75]
    ```
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"project_initial_state needs a Scene, but a {type(scene).__name__} was given.")
    for name, value in (("q0", q0), ("qd0", qd0), ("t0", t0)):
        check_real(value, name=name)
    kind = jnp.result_type(float, *jax.tree_util.tree_leaves(scene))
    q, qd, t = (jnp.asarray(x, kind) for x in (q0, qd0, t0))
    if q.ndim != 1 or q.shape != qd.shape:
        raise ValueError(
            f"q0 and qd0 must both have the shape [dof], but q0 has the shape {q.shape} and qd0 {qd.shape}."
        )
    dof = q.shape[0]
    if t.shape != ():
        raise ValueError(f"t0 must be one number, but has the shape {t.shape}.")
    if not isinstance(hold, list | tuple | range) or not all(isinstance(i, int) and 0 <= i < dof for i in hold):
        raise ValueError(f"hold must be indices of coordinates, 0 to {dof - 1}, as in (0,), but {hold!r} was given.")
    check_scene(scene, State(q, qd, scene.initial_state(q)))
    if not scene.bilateral:
        return q, qd
    free = jnp.asarray([float(i not in hold) for i in range(dof)], kind)
    q, qd, off = _project(scene, t, q, qd, free)
    eps = float(jnp.finfo(kind).eps)
    for error, quantity in zip(off, ("position", "velocity"), strict=True):
        if not float(error) <= 1e3 * eps * max(1.0, float(jnp.max(jnp.abs(q))), float(jnp.max(jnp.abs(qd)))):
            held = f" with the coordinates {tuple(hold)} held" if hold else ""
            raise SimulationError(
                f"No {quantity} near q0 = {q0}, qd0 = {qd0} obeys the constraints{held}: the residual of the last"
                f" iterate, q = {q}, qd = {qd}, is {float(error):.3g}. Start closer to a solution, and check that one"
                " exists."
            )
    return q, qd


@jax.jit
def _project(scene: Scene, t: Array, q: Array, qd: Array, free: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Position, velocity, and the residuals of the constraints."""
    scene = scene.bind_time(t)
    constraints, params = scene.bilateral, scene.params
    mass = motion_equations(scene.lagrangian, t, q, qd, params).mass
    inverse = factor_positive_definite(mass)(jnp.eye(q.shape[0], dtype=q.dtype))
    inverse = inverse * free[:, None] * free[None, :]

    def newton_step(fn: Callable[[Array], Array], x: Array) -> Array:
        """Newton step of least change towards `fn(x) = 0`."""
        value, rows = fn(x), jax.jacrev(fn)(x)
        weighted = rows @ inverse
        return weighted.T @ solve_balanced(weighted @ rows.T, value)

    position, off = errors(constraints, t, params), jnp.zeros_like(t)
    if position(q).shape != (0,):
        q = jax.lax.fori_loop(0, _STEPS, lambda _, q: q - newton_step(position, q), q)
        off = jnp.max(jnp.abs(position(q)))
    velocity = rates(constraints, t, q, params)
    qd = qd - newton_step(velocity, qd)
    return q, qd, (off, jnp.max(jnp.abs(velocity(qd))))
