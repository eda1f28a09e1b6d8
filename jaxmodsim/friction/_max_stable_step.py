"""How large a step an explicit solver can take with a law."""

import math
from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from .._core.shapes import Scalar
from .._core.state_dependent import need_values
from ._law import AbstractDynamicLaw, AbstractForceLaw, AbstractKarnoppLaw, AbstractLaw, AbstractSetValuedLaw

_Part = Callable[[Array, Array], Array]

# How far the stability functions of all explicit methods in use are searched, and in which steps.
_REACH, _GRID = 100.0, 20_000
# Slip [m] that brings a law to its steady state, in steps, and steps of Newton's method after that.
_DISTANCES = np.geomspace(1e-9, 1.0, 10)
_NEWTON = 5
# Relative distance from the steady state at which the law is linearised, on either side.
_BESIDE = 1e-6
# Growth per step that counts as rounding, and the bound on |h lambda| below which an undamped vibration has no step.
_ROUNDING, _NOTHING = 1e-12, 1e-2


def max_stable_step(
    law: AbstractLaw,
    m: float | None = None,
    *,
    v: float = 0.0,
    k: float = 0.0,
    z: PyTree = None,
    solver: dfx.AbstractSolver | dfx.ButcherTableau | None = None,
) -> float:
    """Largest stable step of an explicit solver for a law on a mass, on a spring if there is one.

    The equations `m v' = -k x - F(v, z)`, `z' = rate(v, z)`, `x' = v` are linearised at the velocity v, and the step is
    the largest h below which the solver's stability function holds `|R(h lambda)| <= 1` at every eigenvalue lambda that
    does not grow by itself (as it may on a falling Stribeck curve). Without a mass v is prescribed, and only the
    law's own state runs: for LuGre `2 g(v)/(sigma0 |v|)` with Euler, 2.785 in place of 2 with RK4. Stability is
    not accuracy, and the fastest part of a run decides: ask at its highest speed and in stick.

    **Arguments:**

    - `law`: a law that is a function of velocity or has a state of its own.
    - `m`: mass [kg], > 0; None for a prescribed velocity.
    - `v`: slip velocity [m/s] at which is linearised; 0 is stick.
    - `k`: stiffness of a spring to the ground [N/m], >= 0.
    - `z`: state of the law; by default the steady one at v, and in stick the unloaded one.
    - `solver`: a Runge-Kutta solver of diffrax or a `diffrax.ButcherTableau`, explicit; by default `diffrax.Euler()`.

    **Returns:**

    The step [s]; infinite if nothing limits it, 0 if no step is stable (Euler's method at an undamped vibration).

    **Raises:**

    - `ValueError` for a law whose force jumps, a law by `scaled_by`, an implicit solver, or a number out of range.
    """
    need_values(law, "max_stable_step")
    if not (m is None or m > 0) or not 0 <= k < math.inf or not math.isfinite(v) or (m is None and k > 0):
        raise ValueError(
            f"max_stable_step needs m > 0 [kg] or None, k >= 0 [N/m] (with a mass); given: {m=}, {k=}, {v=}."
        )
    weights = _weights(dfx.Euler() if solver is None else solver)
    speed = jnp.asarray(float(v))
    if isinstance(law, AbstractDynamicLaw) and z is None:
        z = law.initial_state(speed) if v == 0 else _steady(law, speed)
    # As arrays, so that other numbers compile nothing anew.
    mass = None if m is None else jnp.asarray(float(m))
    steps = [math.inf]
    for matrix in np.asarray(_matrices(law, mass, speed, jnp.asarray(float(k)), z), float):
        # Without a spring the displacement only follows, and its zero eigenvalue counts for nothing.
        matrix = matrix if k > 0 or m is None else matrix[1:, 1:]
        eigenvalues = np.linalg.eigvals(matrix)
        scale = np.abs(eigenvalues).max(initial=0.0)
        # Rounding must not make an undamped vibration one that grows.
        decaying = eigenvalues[(eigenvalues.real <= 1e-12 * scale) & (np.abs(eigenvalues) > 1e-12 * scale)]
        steps += [float(_reach(weights, complex(x)) / abs(x)) for x in decaying]
    return min(steps)


@eqx.filter_jit
def _matrices(law: AbstractLaw, m: Scalar | None, v: Scalar, k: Scalar, z: PyTree) -> Float[Array, "2 n n"]:
    """Derivatives of the rates of (x, v, own state) by these, of the own state alone without a mass.

    Some laws have a kink at the limit that steady slip tends to: beside the state `z`, on either side of it.
    """
    own, force, rate = _parts(law, z)

    def field(y: Float[Array, " n"]) -> Float[Array, " n"]:
        if m is None:
            return rate(v, y)
        x, v_, own = y[0], y[1], y[2:]
        # Only the slope counts, so the force that keeps this motion up is left out.
        return jnp.concatenate([jnp.stack([v_, -(k * x + force(v_, own)) / m]), rate(v_, own)])

    motion = jnp.zeros(0) if m is None else jnp.stack([jnp.zeros_like(v), v])
    sides = [own * (1.0 - _BESIDE), own * (1.0 + _BESIDE)]
    return jnp.stack([jax.jacfwd(field)(jnp.concatenate([motion, side])) for side in sides])


def _parts(law: AbstractLaw, z: PyTree) -> tuple[Array, _Part, _Part]:
    """The law's own state in a vector, and its force and rate as functions of velocity and that vector."""
    if isinstance(law, AbstractDynamicLaw):
        own, unravel = jax.flatten_util.ravel_pytree(z)

        def force(v: Array, own: Array) -> Array:
            return law.force(v, unravel(own))

        def rate(v: Array, own: Array) -> Array:
            return jax.flatten_util.ravel_pytree(law.zdot(v, unravel(own)))[0]

    elif isinstance(law, AbstractForceLaw) and not law.jumps:
        own = jnp.zeros(0)

        def force(v: Array, own: Array) -> Array:
            return law.force(v)

        def rate(v: Array, own: Array) -> Array:
            return own

    else:
        raise ValueError(_refusal(law))
    return own, force, rate


@eqx.filter_jit
def _steady(law: AbstractDynamicLaw, v: Scalar) -> PyTree:
    """State of steady slip at `v` [m/s], not zero."""
    z = law.initial_state(v)
    distances = jnp.asarray(_DISTANCES, v.dtype)
    z = jax.lax.scan(lambda z, distance: (law.step_exact(v, z, distance / jnp.abs(v)), None), z, distances)[0]
    # Long steps of laws that split them end beside the steady state: Newton's method closes the rest.
    own, unravel = jax.flatten_util.ravel_pytree(z)

    def rate(own: Array) -> Array:
        return jax.flatten_util.ravel_pytree(law.zdot(v, unravel(own)))[0]

    def newton(_: Array, own: Array) -> Array:
        move = jnp.linalg.lstsq(jax.jacfwd(rate)(own), rate(own))[0]
        better = jnp.max(jnp.abs(rate(own - move))) < jnp.max(jnp.abs(rate(own)))
        return jnp.where(better, own - move, own)

    return unravel(jax.lax.fori_loop(0, _NEWTON, newton, own))


def _refusal(law: AbstractLaw) -> str:
    name = type(law).__name__
    if isinstance(law, AbstractForceLaw | AbstractSetValuedLaw):
        return (
            f"max_stable_step: the force of {name} jumps at v = 0, where every step chatters. simulate runs Coulomb and"
            " Stribeck by events, whatever the step; Regularized(law, width) makes them smooth and has a largest step."
        )
    if isinstance(law, AbstractKarnoppLaw):
        return (
            f"max_stable_step: {name} has no slope in its band and jumps at the edges. Its step is bounded otherwise:"
            " the velocity must not change by more than the band in one step."
        )
    return f"max_stable_step knows nothing of laws such as {name}."


def _weights(solver: object) -> tuple[list[np.ndarray], np.ndarray]:
    """Rows below the diagonal, and weights, of an explicit Runge-Kutta method."""
    if isinstance(solver, dfx.Euler):
        return [], np.ones(1)
    tableau = solver if isinstance(solver, dfx.ButcherTableau) else getattr(solver, "tableau", None)
    if not isinstance(tableau, dfx.ButcherTableau) or tableau.implicit:
        raise ValueError(
            "max_stable_step needs an explicit Runge-Kutta solver, such as diffrax.Heun() or diffrax.Tsit5(), or its"
            f" ButcherTableau, but {solver!r} was given. Implicit solvers such as Rodas5P take stiff laws at any step."
        )
    return [np.asarray(row, float) for row in tableau.a_lower], np.asarray(tableau.b_sol, float)


def _amplification(
    weights: tuple[list[np.ndarray], np.ndarray], x: Complex[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """`|R(x)|`, by how much a step multiplies a motion with `h lambda = x`."""
    rows, b = weights
    stages = [np.ones_like(x)]
    for row in rows:
        stages.append(1.0 + x * sum(a * stage for a, stage in zip(row, stages, strict=True)))
    return np.abs(1.0 + x * sum(c * stage for c, stage in zip(b, stages, strict=True)))


def _reach(weights: tuple[list[np.ndarray], np.ndarray], eigenvalue: complex) -> float:
    """Largest `|h lambda|` below which no step makes a motion with this eigenvalue grow."""
    direction = eigenvalue / abs(eigenvalue)
    grid = np.linspace(0.0, _REACH, _GRID + 1)
    for _ in range(3):
        grows = _amplification(weights, grid * direction) > 1.0 + _ROUNDING
        i = int(np.argmax(grows))
        if not grows.any():
            return math.inf
        if i == 0:
            break
        grid = np.linspace(grid[i - 1], grid[i], _GRID + 1)
    undamped = abs(direction.real) < _ROUNDING
    return 0.0 if undamped and grid[0] < _NOTHING else float(grid[0])
