"""Whether a law can give back more energy than was put into it."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._core.parameters import modules_of
from .._core.state_dependent import need_values
from ._law import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw, AbstractSetValuedLaw
from ._passivity import Array, Passivity, first_negative, least_on, logarithmic

_SLOWEST = 1e-9  # [m/s], where the search of speeds begins
_STATES = 2000  # states that a law without a closed form is brought to


def check_passivity(law: AbstractLaw, *, v_max: float = 1e3) -> Passivity:
    """Whether a law is passive from slip velocity to force: it never returns more energy than it was given.

    The energy in its state, `law.stored_energy`, is the storage, so the question is whether the dissipation
    `D = v F(v, z) - d/dt stored(z)` is >= 0 at all velocities and all states that can be reached. The margin is
    the least `D/v^2`: a term `sigma v` more in the force adds `sigma v^2` to D.

    A law that has a closed form says it by its method `passivity`, where the condition is derived. For the others:

    - Functions of velocity and set-valued laws: `F(v) v >= 0`, searched over both directions.
    - Laws with a state: at many states that their `step_exact` reaches. That can refute, but not prove.

    **Arguments:**

    - `law`: any law that has values by itself. What `scaled_by` made depend on the mechanism is judged at one state,
      `check_passivity(law.bind_state(t, q, qd, params))`; that says nothing about the energy that a change of the load
      brings into a bristle whose stiffness follows it.
    - `v_max`: largest speed searched [m/s], > 0, for laws without a closed form; others are judged at all speeds.

    **Returns:**

    A `Passivity`.

    **Raises:**

    - `ValueError` for a law by `scaled_by`, what is no law, or a force that is not finite.

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
            f"check_passivity needs a law, but {law!r} was given; of a function of velocity make a Curve(fn)."
        )
    need_values(law, "check_passivity")
    known = law.passivity()
    if known is not None:
        return known
    if isinstance(law, AbstractForceLaw):
        return _function(law, lambda law, v: law.force(v), v_max)
    if isinstance(law, AbstractSetValuedLaw):
        return _function(law, lambda law, v: jnp.sign(v) * law.sliding_force(v) + law.viscous_force(v), v_max)
    if isinstance(law, AbstractDynamicLaw):
        return _sampled(law, v_max)
    raise ValueError(f"check_passivity knows nothing of laws such as {type(law).__name__}.")


def _function(law: AbstractLaw, force: Callable[..., jax.Array], v_max: float) -> Passivity:
    """A force that is a function of the velocity."""
    dtype = _dtype(law)
    forces = jax.jit(jax.vmap(force, in_axes=(None, 0)))

    def least(v: Array) -> Array:
        both = jnp.concatenate([jnp.asarray(v, dtype), -jnp.asarray(v, dtype)])
        ratios = np.asarray(forces(law, both)).astype(float) / np.asarray(both).astype(float)
        if not np.isfinite(ratios).all():
            where = float(both[int(np.argmin(np.isfinite(ratios)))])
            raise ValueError(f"check_passivity: the force is not finite at v = {where:g} m/s; give a v_max below that.")
        return np.minimum(*np.split(ratios, 2))

    grid = logarithmic(_SLOWEST, v_max)
    margin, worst = least_on(least, grid)
    range_ = f"for |v| <= {v_max:g} m/s"
    if all(getattr(module, "valid_at_any_speed", False) for _, module in modules_of(law)):
        far = float(least(np.array([float(jnp.finfo(dtype).max) ** 0.9]))[0])
        margin = min(margin, 0.0 if abs(far) < 1e-30 else far)
        range_ = "at every speed"
    words = f"F(v) v >= 0 is needed; F/v is at least {margin:g} N s/m {range_}"
    if margin >= 0:
        return Passivity(True, margin, math.inf, f"{words}.")
    return Passivity(False, margin, first_negative(least, grid), f"{words}, and least at {worst:g} m/s.")


def _sampled(law: AbstractDynamicLaw, v_max: float) -> Passivity:
    """A law that nothing is known of: at the states that random slip brings it to."""
    dtype = _dtype(law)
    # A fixed seed: the same law gives the same answer.
    random = np.random.default_rng(0)
    slips = random.choice([-1.0, 1.0], _STATES) * 10.0 ** random.uniform(-6.0, math.log10(v_max), _STATES)
    times = 10.0 ** random.uniform(-9.0, 1.0, _STATES) / np.abs(slips)
    speeds = logarithmic(_SLOWEST, v_max, per_decade=20)
    both = jnp.asarray(np.concatenate([speeds, -speeds]), dtype)
    lost = np.asarray(_losses(law, jnp.asarray(slips, dtype), jnp.asarray(times, dtype), both)).astype(float)
    index = lost / np.square(np.asarray(both).astype(float))
    if not np.isfinite(index).all():
        raise ValueError(
            f"check_passivity: the power of {type(law).__name__} is not finite at speeds up to {v_max:g} m/s."
        )
    by_speed = np.min(np.minimum(*np.split(index, 2, axis=1)), axis=0)
    margin = float(by_speed.min())
    words = f"v F - d/dt stored over v^2 is at least {margin:g} N s/m at {_STATES} states for |v| <= {v_max:g} m/s"
    if margin >= 0:
        return Passivity(True, margin, math.inf, f"{words}: not refuted by sampling, which is no proof.")
    return Passivity(False, margin, float(speeds[int(np.argmax(by_speed < 0))]), f"{words}.")


@eqx.filter_jit
def _losses(law: AbstractDynamicLaw, slips: jax.Array, times: jax.Array, speeds: jax.Array) -> jax.Array:
    """Dissipation [W] at each state along the slip and each speed, shape `[state, speed]`; 0 where it is rounding."""

    def step(z: PyTree, x: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        z = law.step_exact(x[0], z, x[1])
        return z, z

    states = jax.lax.scan(step, law.initial_state(jnp.zeros((), slips.dtype)), (slips, times))[1]

    def lost(z: PyTree, v: jax.Array) -> jax.Array:
        given = v * law.force(v, z)
        parts = jax.tree.map(lambda slope, rate: jnp.vdot(slope, rate), jax.grad(law.stored_energy)(z), law.zdot(v, z))
        kept = jnp.stack(jax.tree.leaves(parts))
        rounding = 64.0 * jnp.finfo(v.dtype).eps * (jnp.abs(given) + jnp.sum(jnp.abs(kept)))
        net = given - jnp.sum(kept)
        return jnp.where(jnp.abs(net) <= rounding, 0.0, net)

    return jax.vmap(jax.vmap(lost, in_axes=(None, 0)), in_axes=(0, None))(states, speeds)


def _dtype(law: AbstractLaw) -> np.dtype:
    """Floating type of the law's numbers."""
    return jnp.result_type(float, *[x.dtype for x in jax.tree.leaves(law) if eqx.is_inexact_array(x)][:1])
