"""A mass on a spring under a force `u`, with friction: what the tests of fits identify."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

import jaxmodsim as jms


def lagrangian(t: Any, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def _drive(t: Any, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))


DRIVE = jms.AppliedForce(_drive)


def sprung_mass(*effects: Any, m: float = 2.0, k: float = 20.0, **params: float) -> jms.Scene:
    return jms.Scene(lagrangian, params={"m": m, "k": k, "u": 0.0, **params}, effects=effects)


def sprung(m: float = 2.0, Fc: float = 1.5, Fv: float = 0.6) -> jms.Scene:
    """With smooth Coulomb friction and a viscous part."""
    friction = jms.Friction(jms.Regularized(jms.Coulomb(Fc), 1e-2))
    return sprung_mass(DRIVE, friction, jms.Friction(jms.Viscous(Fv), name="viscous"), m=m)
