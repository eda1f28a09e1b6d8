"""A law under a prescribed slip velocity, without a mechanism."""

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ...friction import AbstractDynamicLaw, AbstractForceLaw, AbstractKarnoppLaw, AbstractLaw, AbstractSetValuedLaw

# Samples of every drive: of one length, so that each law is compiled once for all experiments.
SAMPLES = 8192


class Response(NamedTuple):
    """What a law does under a drive, shape `[samples]` each.

    - `force`: at the end of the sample [N].
    - `work`: taken up by friction in the sample [J], by the trapezoidal rule.
    - `stored`: energy in the law's state at the end of the sample [J].
    """

    force: np.ndarray
    work: np.ndarray
    stored: np.ndarray


def respond(law: AbstractLaw, v: np.ndarray, dt: np.ndarray) -> Response:
    """Drive a law from rest, unloaded.

    **Arguments:**

    - `law`: of any kind.
    - `v`: slip velocity in each sample [m/s], not zero, shape `[SAMPLES]`.
    - `dt`: duration of each sample [s].

    **Returns:**

    A `Response`. The state of a dynamic law is advanced exactly over each sample.
    """
    assert v.shape == dt.shape == (SAMPLES,)
    return Response(*(np.asarray(x) for x in _respond(law, v, dt)))


@jax.jit
def _respond(law: AbstractLaw, v: Array, dt: Array) -> tuple[Array, Array, Array]:
    def over(carry: PyTree, sample: tuple[Array, Array]) -> tuple[PyTree, tuple[Array, Array, Array]]:
        (t, x, z), (v, dt) = carry, sample
        t, x = t + dt, x + v * dt
        here = law.bind_state(t, x[None], v[None], {})
        if not isinstance(here, AbstractDynamicLaw):
            force = _slip_force(here, v)
            return (t, x, z), (force, force * v * dt, jnp.zeros_like(v))
        before, z = here.force(v, z), here.step_exact(v, z, dt)
        after = here.force(v, z)
        return (t, x, z), (after, 0.5 * (before + after) * v * dt, here.stored_energy(z))

    rest = jnp.zeros_like(v[0])
    first = law.bind_state(rest, rest[None], rest[None], {})
    z = first.initial_state(rest) if isinstance(first, AbstractDynamicLaw) else None
    return jax.lax.scan(over, (rest, rest, z), (v, dt))[1]


def _slip_force(law: AbstractLaw, v: Float[Array, ""]) -> Float[Array, ""]:
    """Force [N] in slip of a law without a state."""
    if isinstance(law, AbstractSetValuedLaw):
        return law.sliding_force(v) * jnp.sign(v) + law.viscous_force(v)
    assert isinstance(law, AbstractForceLaw | AbstractKarnoppLaw)
    return law.force(v)


def needs_load(law: AbstractLaw, v: float) -> bool:
    """Whether the force at the slip velocity `v` [m/s] is that of the load, so that no motion by itself gives it."""
    return isinstance(law, AbstractKarnoppLaw) and bool(law.holds(jnp.asarray(v)))


NEEDS_LOAD = "In its band the force is the load, which a prescribed motion does not say."


def path(*places: float, samples: int) -> np.ndarray:
    """Displacements [m] of a way from place to place, each leg with the same number of samples, without the start."""
    legs = [np.linspace(a, b, samples + 1)[1:] for a, b in pairwise(places)]
    return np.concatenate(legs)
