"""Check whether a law can return more energy than it received."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._core.functions import need_values
from .._core.parameters import modules_of
from ._law import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw, AbstractSetValuedLaw, Passivity

_SLOWEST = 1e-9  # lowest speed of the search [m/s]
_STATES = 2000  # sampled states of a law without a closed form


def check_passivity(law: AbstractLaw, *, v_max: float = 1e3) -> Passivity:
    """Check whether a law is passive from slip velocity to force: it never returns more energy than it received.

    The storage function is the energy in the state of the law, `law.stored_energy`. The law is passive if the
    dissipation `D = v F(v, z) - d/dt stored_energy(z)` is >= 0 at all velocities and all reachable states. The margin
    is the least `D/v^2`: an additional term `sigma v` in the force adds `sigma v^2` to D.

    If the law has a closed form, its method `passivity` returns it and documents the derivation. For other laws:

    - Functions of velocity and set-valued laws: search for `F(v) v < 0` in both directions.
    - Laws with a state: sample D at many states that `step_exact` reaches. This can refute passivity, but not prove it.

    **Arguments:**

    - `law`: any law. For a law by `scaled_by`, check one state at a time,
      `check_passivity(law.bind_state(t, q, qd, params))`. This does not cover the energy that a varying load adds to a
      bristle whose stiffness depends on it.
    - `v_max`: largest speed of the search [m/s], > 0. A closed form covers all speeds.

    **Returns:**

    A `Passivity`.

    **Raises:**

    - `ValueError` if `law` is not a law, depends on the state of the mechanism, or has a force that is not finite; if
      `v_max` is out of range.

    **Example:**

    ```python
    law = jms.LuGre(sigma0=1e5, sigma1=300.0, sigma2=0.4, Fc=1.0, Fs=1.5, vs=0.01)
    result = jms.check_passivity(law)
    print(result.ok, f"margin {result.margin:.1f} N s/m")
    ```

    ```text
    False margin -149.6 N s/m
    ```

    ??? cite "Reference"

        ```bibtex
        @article{astrom2008revisiting,
            author={Astrom, Karl Johan and Canudas de Wit, Carlos},
            title={Revisiting the {LuGre} friction model},
            journal={IEEE Control Systems Magazine},
            volume={28}, number={6}, pages={101--114}, year={2008},
        }
        ```
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(
            f"check_passivity needs a law, but {law!r} was given; convert a function of velocity by Curve(fn)."
        )
    need_values(law, "check_passivity")
    known = law.passivity()
    if known is not None:
        return known
    if isinstance(law, AbstractForceLaw):
        return _search_speeds(law, lambda law, v: law.force(v), v_max)
    if isinstance(law, AbstractSetValuedLaw):
        return _search_speeds(law, lambda law, v: jnp.sign(v) * law.sliding_force(v) + law.viscous_force(v), v_max)
    if isinstance(law, AbstractDynamicLaw):
        return _sample_states(law, v_max)
    raise ValueError(f"check_passivity does not support laws such as {type(law).__name__}.")


def _search_speeds(law: AbstractLaw, force: Callable[..., jax.Array], v_max: float) -> Passivity:
    """Passivity of a law whose force is a function of velocity."""
    dtype = _dtype(law)
    forces = jax.jit(jax.vmap(force, in_axes=(None, 0)))

    def least(v: np.ndarray) -> np.ndarray:
        both = jnp.concatenate([jnp.asarray(v, dtype), -jnp.asarray(v, dtype)])
        ratios = np.asarray(forces(law, both)).astype(float) / np.asarray(both).astype(float)
        if not np.isfinite(ratios).all():
            where = float(both[int(np.argmin(np.isfinite(ratios)))])
            raise ValueError(f"check_passivity: the force is not finite at v = {where:g} m/s; use a smaller v_max.")
        return np.minimum(*np.split(ratios, 2))

    grid = logarithmic(_SLOWEST, v_max)
    margin, worst = least_on(least, grid)
    range_ = f"for |v| <= {v_max:g} m/s"
    if all(getattr(module, "valid_at_any_speed", False) for _, module in modules_of(law)):
        far = float(least(np.array([float(jnp.finfo(dtype).max) ** 0.9]))[0])
        margin = min(margin, 0.0 if abs(far) < 1e-30 else far)
        range_ = "at every speed"
    condition = f"F(v) v >= 0 is required; F/v is at least {margin:g} N s/m {range_}"
    if margin >= 0:
        return Passivity(True, margin, math.inf, f"{condition}.")
    return Passivity(False, margin, first_negative(least, grid), f"{condition}, with the minimum at {worst:g} m/s.")


def _sample_states(law: AbstractDynamicLaw, v_max: float) -> Passivity:
    """Passivity of a law with a state, at states that random slip reaches."""
    dtype = _dtype(law)
    # A fixed seed makes the result reproducible.
    random = np.random.default_rng(0)
    slips = random.choice([-1.0, 1.0], _STATES) * 10.0 ** random.uniform(-6.0, math.log10(v_max), _STATES)
    times = 10.0 ** random.uniform(-9.0, 1.0, _STATES) / np.abs(slips)
    speeds = logarithmic(_SLOWEST, v_max, per_decade=20)
    both = jnp.asarray(np.concatenate([speeds, -speeds]), dtype)
    losses = np.asarray(_dissipation(law, jnp.asarray(slips, dtype), jnp.asarray(times, dtype), both)).astype(float)
    margins = losses / np.square(np.asarray(both).astype(float))
    if not np.isfinite(margins).all():
        raise ValueError(
            f"check_passivity: the power of {type(law).__name__} is not finite at speeds up to {v_max:g} m/s."
        )
    by_speed = np.min(np.minimum(*np.split(margins, 2, axis=1)), axis=0)
    margin = float(by_speed.min())
    condition = f"The dissipation over v^2 is at least {margin:g} N s/m at {_STATES} states for |v| <= {v_max:g} m/s"
    if margin >= 0:
        return Passivity(True, margin, math.inf, f"{condition}: samples are no proof.")
    return Passivity(False, margin, float(speeds[int(np.argmax(by_speed < 0))]), f"{condition}.")


@eqx.filter_jit
def _dissipation(law: AbstractDynamicLaw, slips: jax.Array, times: jax.Array, speeds: jax.Array) -> jax.Array:
    """Dissipation [W] at each state along the slips and each speed, shape `[state, speed]`; 0 if it is rounding."""

    def step(z: PyTree, x: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        z = law.step_exact(x[0], z, x[1])
        return z, z

    states = jax.lax.scan(step, law.initial_state(jnp.zeros((), slips.dtype)), (slips, times))[1]

    def loss(z: PyTree, v: jax.Array) -> jax.Array:
        power = v * law.force(v, z)
        parts = jax.tree.map(lambda slope, rate: jnp.vdot(slope, rate), jax.grad(law.stored_energy)(z), law.zdot(v, z))
        stored = jnp.stack(jax.tree.leaves(parts))
        rounding = 64.0 * jnp.finfo(v.dtype).eps * (jnp.abs(power) + jnp.sum(jnp.abs(stored)))
        net = power - jnp.sum(stored)
        return jnp.where(jnp.abs(net) <= rounding, 0.0, net)

    return jax.vmap(jax.vmap(loss, in_axes=(None, 0)), in_axes=(0, None))(states, speeds)


def _dtype(law: AbstractLaw) -> np.dtype:
    """Floating type of the law's numbers."""
    return jnp.result_type(float, *[x.dtype for x in jax.tree.leaves(law) if eqx.is_inexact_array(x)][:1])


def logarithmic(low: float, high: float, per_decade: int = 200) -> np.ndarray:
    """Speeds [m/s] from `low` to `high`, with equal ratios."""
    if not 0 < high < math.inf or high <= low:
        raise ValueError(f"check_passivity: v_max must be finite and above {low:g} [m/s], but {high} was given.")
    return np.geomspace(low, high, 2 + math.ceil(per_decade * math.log10(high / low)))


def least_on(fn: Callable[[np.ndarray], np.ndarray], grid: np.ndarray) -> tuple[float, float]:
    """Minimum of `fn` on `grid`, refined about it, and its location."""
    values = fn(grid)
    least, where = float(values.min()), float(grid[int(np.argmin(values))])
    for _ in range(4):
        i = int(np.argmin(values))
        grid = np.geomspace(grid[max(i - 1, 0)], grid[min(i + 1, grid.size - 1)], grid.size)
        values = fn(grid)
        if float(values.min()) < least:
            least, where = float(values.min()), float(grid[int(np.argmin(values))])
    return least, where


def first_negative(fn: Callable[[np.ndarray], np.ndarray], grid: np.ndarray) -> float:
    """Speed at which `fn` first becomes negative on `grid`, refined between grid points."""
    for _ in range(4):
        i = int(np.argmax(fn(grid) < 0))
        if i == 0:
            return float(grid[0])
        grid = np.geomspace(grid[i - 1], grid[i], grid.size)
    return float(grid[0])
