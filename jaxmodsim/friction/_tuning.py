"""Choose numbers of a law and of a run: bristle damping, regularization width, and the largest stable step."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from .._core.arrays import Scalar
from .._core.functions import need_values
from ._law import AbstractDynamicLaw, AbstractForceLaw, AbstractKarnoppLaw, AbstractLaw, AbstractSetValuedLaw
from ._wrappers import Regularized

# Grid of velocities below the creep speed, and largest number of bisections of the width.
_SPEEDS, _HALVINGS = 2000, 200
# Range and number of intervals of the search for the stability limit |h lambda|.
_REACH, _GRID = 100.0, 20_000
# Slips [m] that bring a law to its steady state, and subsequent steps of Newton's method.
_DISTANCES = np.geomspace(1e-9, 1.0, 10)
_NEWTON = 5
# Relative distance from the steady state at which the law is linearized, on both sides.
_BESIDE = 1e-6
# Growth per step that counts as rounding; |h lambda| below which an undamped vibration counts as unstable at any step.
_ROUNDING, _NOTHING = 1e-12, 1e-2

_Part = Callable[[Array, Array], Array]


def damping_sigma1(m: float, sigma0: float, ratio: float = 1.0, sigma2: float = 0.0) -> float:
    """Bristle damping [N s/m] that gives a mass in stick a damping ratio.

    In stick `z' = v`, so `m v' = -sigma0 z - (sigma1 + sigma2) v` for LuGre and for ElastoPlastic, and
    `sigma1 = 2 ratio sqrt(m sigma0) - sigma2`. If Fs > Fc, a law with sigma1 above `sigma2 Fc/(Fs - Fc)` is not passive
    (`check_passivity`). Stiff bristles soon exceed this; LuGre with `vd` close to vs keeps the damping in stick.

    **Arguments:**

    - `m`: mass [kg] or inertia [kg m^2] on which the law acts, > 0.
    - `sigma0`: bristle stiffness [N/m], > 0.
    - `ratio`: damping ratio, > 0: 1 is critical.
    - `sigma2`: viscous coefficient of the law [N s/m], >= 0, which adds to the damping.

    **Returns:**

    The damping sigma1 [N s/m], >= 0.

    **Raises:**

    - `ValueError` if a number is out of range, or sigma2 alone gives a higher damping ratio.

    **Example:**

    ```python
    print(f"{jms.damping_sigma1(m=2.0, sigma0=1e5, ratio=0.5):.1f} N s/m")
    ```

    ```text
    447.2 N s/m
    ```
    """
    for name, value in (("m", m), ("sigma0", sigma0), ("ratio", ratio)):
        if not 0 < value < math.inf:
            raise ValueError(f"damping_sigma1: {name} must be finite and > 0, but {value} was given.")
    if not 0 <= sigma2 < math.inf:
        raise ValueError(f"damping_sigma1: sigma2 must be finite and >= 0 [N s/m], but {sigma2} was given.")
    critical = 2.0 * math.sqrt(m * sigma0)
    sigma1 = ratio * critical - sigma2
    if sigma1 < 0:
        raise ValueError(
            f"damping_sigma1: sigma2 = {sigma2:g} N s/m alone gives the damping ratio {sigma2 / critical:g}, above"
            f" {ratio:g}: a sigma1 of {sigma1:g} N s/m would be needed. Use 0, or a smaller sigma2."
        )
    return float(sigma1)


@dataclass(frozen=True)
class Width:
    """A width of `Regularized` with its creep velocity and its largest step. `print` shows it as a sentence.

    - `width`: the width [m/s].
    - `creep`: velocity [m/s] at which the mass creeps under the load, with the sign of the load.
    - `load`: the load [N].
    - `rate`: fastest decay [1/s] of the mass's velocity, at rest: `(static limit/width + slope of the viscous part)/m`.
    - `step`: largest stable step [s] of Euler's method at that rate.
    - `law`: the law with that width.
    """

    width: float
    creep: float
    load: float
    rate: float
    step: float
    law: Regularized = field(repr=False)

    def __str__(self) -> str:
        """All numbers in a sentence."""
        return (
            f"A width of {self.width:.4g} m/s: under {self.load:g} N it creeps at {self.creep:.4g} m/s, and velocities"
            f" decay at up to {self.rate:.4g} 1/s, so explicit Euler steps must stay below {self.step:.4g} s."
        )


def regularized_width(law: AbstractSetValuedLaw, creep: float, load: float, m: float) -> Width:
    """Largest width of `Regularized` for which a mass under a load creeps at most at the allowed speed.

    A regularized law has no stick: under a load below the limit the mass creeps at the velocity where `F(v) = load`.
    The width solves `F(creep) = load` for the force of the law, with its stiction hump and its fall. If the force
    reaches the load at a lower velocity than `creep`, the mass creeps at that velocity.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.
    - `creep`: allowed creep speed [m/s], > 0.
    - `load`: load to carry [N], not zero, smaller than the limit of stick; its sign is the direction of the load.
    - `m`: mass [kg], > 0, which determines the rate.

    **Returns:**

    A `Width`.

    **Raises:**

    - `ValueError` if a number is out of range, the law is not set-valued or depends on the state of the mechanism, or
      no width carries the load: the smooth hump of a law with stiction stays below its limit.

    **Example:**

    ```python
    result = jms.regularized_width(jms.Coulomb(Fc=5.0), creep=1e-4, load=3.0, m=2.0)
    print(f"width {result.width:.3g} m/s, Euler steps below {result.step:.3g} s")
    ```

    ```text
    width 0.000144 m/s, Euler steps below 0.000115 s
    ```
    """
    if not isinstance(law, AbstractSetValuedLaw):
        raise ValueError(f"regularized_width needs a set-valued law such as Coulomb, but {law!r} was given.")
    need_values(law, "regularized_width")
    for name, value in (("creep", creep), ("m", m)):
        if not 0 < value < math.inf:
            raise ValueError(f"regularized_width: {name} must be finite and > 0, but {value} was given.")
    side = math.copysign(1.0, load)
    limit = float(law.static_limit(jnp.asarray(side)))
    if not 0 < abs(load) < limit:
        raise ValueError(
            f"regularized_width: the load must be above 0 and below the limit of stick, {limit:g} N, but {load} N was"
            " given. Above the limit the mass slides at any width."
        )
    speeds = jnp.asarray(np.append(creep * np.geomspace(1e-9, 1.0, _SPEEDS)[:-1], creep))

    @jax.jit
    def forces(width: Scalar, speeds: Float[Array, " n"]) -> Float[Array, " n"]:
        return side * jax.vmap(Regularized(law, width).force)(side * speeds)

    def peak(width: float) -> float:
        return float(jnp.max(forces(jnp.asarray(width), speeds)))

    narrow, wide = 1e-6 * creep, 1e6 * creep
    most, least = peak(narrow), peak(wide)
    if least >= abs(load) or most < abs(load):
        raise ValueError(_no_width(law, load, creep, limit, most, least))
    for _ in range(_HALVINGS):
        middle = math.sqrt(narrow * wide)
        if not narrow < middle < wide:
            break
        narrow, wide = (middle, wide) if peak(middle) >= abs(load) else (narrow, middle)
    reached = np.asarray(forces(jnp.asarray(narrow), speeds)) >= abs(load)
    first = int(np.argmax(reached))
    near = jnp.linspace(speeds[max(first - 1, 0)], speeds[first], _SPEEDS + 1)[1:]
    crossed = np.asarray(forces(jnp.asarray(narrow), near)) >= abs(load)
    crept = creep if first == _SPEEDS - 1 else float(near[int(np.argmax(crossed))])
    smooth = Regularized(law, narrow)
    # An asymmetric law has a kink at zero: take the slope on the side of the load.
    step = max_stable_step(smooth, m, v=side * narrow * 1e-9)
    return Width(narrow, side * crept, load, 2.0 / step, step, smooth)


def _no_width(law: AbstractSetValuedLaw, load: float, creep: float, limit: float, most: float, least: float) -> str:
    name = type(law).__name__
    if least >= abs(load):
        return f"regularized_width: the viscous part of {name} carries {load:g} N at {creep:g} m/s: any width will do."
    return (
        f"regularized_width: no width of {name} carries {load:g} N below {creep:g} m/s. The smooth force reaches"
        f" {most:g} N at most, below the limit of {limit:g} N. Without the wrapper the law holds the load at rest."
    )


def max_stable_step(
    law: AbstractLaw,
    m: float | None = None,
    *,
    v: float = 0.0,
    k: float = 0.0,
    z: PyTree = None,
    solver: dfx.AbstractSolver | dfx.ButcherTableau | None = None,
) -> float:
    """Largest stable step of an explicit solver for a law on a mass, with an optional spring.

    The equations `m v' = -k x - F(v, z)`, `z' = zdot(v, z)`, `x' = v` are linearized at the velocity v. The result is
    the largest h below which the solver's stability function satisfies `|R(h lambda)| <= 1` for every eigenvalue lambda
    of a decaying motion. (Motions may grow on a falling Stribeck curve.) Without a mass v is prescribed, and only the
    state of the law is integrated: for LuGre the step is `2 g(v)/(sigma0 |v|)` with Euler, with 2.785 instead of 2 for
    RK4. Stability does not imply accuracy. The fastest motion of a run limits its step: check its highest speed and
    stick.

    **Arguments:**

    - `law`: a law that is a function of velocity or has a state.
    - `m`: mass [kg], > 0; None for a prescribed velocity.
    - `v`: slip velocity of the linearization [m/s]; 0 is stick.
    - `k`: stiffness of a spring to the ground [N/m], >= 0.
    - `z`: state of the law; by default the steady state at v, and in stick the unloaded state.
    - `solver`: a Runge-Kutta solver of diffrax or a `diffrax.ButcherTableau`, explicit; by default `diffrax.Euler()`.

    **Returns:**

    The step [s]; infinite if any step is stable, 0 if none is (Euler's method for an undamped vibration).

    **Raises:**

    - `ValueError` if the force of the law jumps, the law depends on the state of the mechanism, the solver is implicit,
      or a number is out of range.

    **Example:**

    ```python
    law = jms.LuGre(sigma0=1e5, sigma1=300.0, sigma2=0.4, Fc=1.0, Fs=1.5, vs=0.01)
    print(f"{jms.max_stable_step(law, m=1.0, v=0.1, solver=diffrax.Tsit5()):.3g} s")
    ```

    ```text
    0.000351 s
    ```
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
    # Arrays, so that other numbers do not recompile.
    mass = None if m is None else jnp.asarray(float(m))
    steps = [math.inf]
    for matrix in np.asarray(_matrices(law, mass, speed, jnp.asarray(float(k)), z), float):
        # Without a spring nothing depends on the displacement: drop its zero eigenvalue.
        matrix = matrix if k > 0 or m is None else matrix[1:, 1:]
        eigenvalues = np.linalg.eigvals(matrix)
        scale = np.abs(eigenvalues).max(initial=0.0)
        # Tolerances keep an undamped vibration, whose real part is rounding.
        decaying = eigenvalues[(eigenvalues.real <= 1e-12 * scale) & (np.abs(eigenvalues) > 1e-12 * scale)]
        steps += [float(_stability_limit(weights, complex(x)) / abs(x)) for x in decaying]
    return min(steps)


@eqx.filter_jit
def _matrices(law: AbstractLaw, m: Scalar | None, v: Scalar, k: Scalar, z: PyTree) -> Float[Array, "2 n n"]:
    """Jacobians of the rates of (x, v, state of the law), or of the state alone without a mass.

    Some laws have a kink at the state of steady slip, so there is one Jacobian on either side of `z`.
    """
    own, force, rate = _parts(law, z)

    def field(y: Float[Array, " n"]) -> Float[Array, " n"]:
        if m is None:
            return rate(v, y)
        x, v_, own = y[0], y[1], y[2:]
        # The Jacobian does not depend on the force that sustains this motion.
        return jnp.concatenate([jnp.stack([v_, -(k * x + force(v_, own)) / m]), rate(v_, own)])

    motion = jnp.zeros(0) if m is None else jnp.stack([jnp.zeros_like(v), v])
    sides = [own * (1.0 - _BESIDE), own * (1.0 + _BESIDE)]
    return jnp.stack([jax.jacfwd(field)(jnp.concatenate([motion, side])) for side in sides])


def _parts(law: AbstractLaw, z: PyTree) -> tuple[Array, _Part, _Part]:
    """State of the law as a vector, and its force and rate as functions of velocity and that vector."""
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
    """State in steady slip at `v` [m/s], not zero."""
    z = law.initial_state(v)
    distances = jnp.asarray(_DISTANCES, v.dtype)
    z = jax.lax.scan(lambda z, distance: (law.step_exact(v, z, distance / jnp.abs(v)), None), z, distances)[0]
    # `step_exact` of some laws is approximate for long steps: Newton's method converges to the steady state.
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
            " Stribeck by events, at any step; Regularized(law, width) is smooth and has a largest stable step."
        )
    if isinstance(law, AbstractKarnoppLaw):
        return (
            f"max_stable_step: {name} has no slope in its band and jumps at the edges. Choose the step such that the"
            " velocity changes by less than the band in one step."
        )
    return f"max_stable_step does not support laws such as {name}."


def _weights(solver: object) -> tuple[list[np.ndarray], np.ndarray]:
    """Lower rows of the matrix, and weights, of an explicit Runge-Kutta method."""
    if isinstance(solver, dfx.Euler):
        return [], np.ones(1)
    tableau = solver if isinstance(solver, dfx.ButcherTableau) else getattr(solver, "tableau", None)
    if not isinstance(tableau, dfx.ButcherTableau) or tableau.implicit:
        raise ValueError(
            "max_stable_step needs an explicit Runge-Kutta solver, such as diffrax.Heun() or diffrax.Tsit5(), or its"
            f" ButcherTableau, but {solver!r} was given. Implicit solvers such as Rodas5P are stable at any step."
        )
    return [np.asarray(row, float) for row in tableau.a_lower], np.asarray(tableau.b_sol, float)


def _amplification(
    weights: tuple[list[np.ndarray], np.ndarray], x: Complex[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Growth `|R(x)|` per step of a motion with `h lambda = x`."""
    rows, b = weights
    stages = [np.ones_like(x)]
    for row in rows:
        stages.append(1.0 + x * sum(a * stage for a, stage in zip(row, stages, strict=True)))
    return np.abs(1.0 + x * sum(c * stage for c, stage in zip(b, stages, strict=True)))


def _stability_limit(weights: tuple[list[np.ndarray], np.ndarray], eigenvalue: complex) -> float:
    """Largest `|h lambda|` up to which a motion with this eigenvalue does not grow."""
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
