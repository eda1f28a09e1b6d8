"""Scenes of the systems that `stick_slip_motion` has the reference of."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..friction import Coulomb
from ..scene import AppliedForce, Friction, Scene, Signal
from ._piecewise import LinearStickSlip


def _waves(t: Array, frequencies: Array) -> Array:
    """What the loads of a `LinearStickSlip` are combinations of, but for the sampled signal."""
    sine, cosine = jnp.sin(frequencies * t), jnp.cos(frequencies * t)
    harmonics = jnp.stack([sine, cosine, t * sine, t * cosine], axis=1)
    return jnp.concatenate([jnp.stack([jnp.ones_like(t), t, t * t]), jnp.reshape(harmonics, -1)])


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del t
    kinetic = 0.5 * jnp.sum(qd * jnp.sum(p["mass"] * qd[None, :], axis=1))
    return kinetic - 0.5 * jnp.sum(q * jnp.sum(p["stiffness"] * q[None, :], axis=1))


def _load(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    del q
    waves = jnp.sum(p["load"] * _waves(t, p["frequencies"])[None, :], axis=1)
    return waves - jnp.sum(p["damping"] * qd[None, :], axis=1)


def _load_and_signal(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return _load(t, q, qd, p) + p["signal_load"] * p["signal"]


class _Along(eqx.Module):
    """Displacement of an element."""

    row: Float[Array, " dof"]

    def __call__(self, q: Array) -> Array:
        """Its value [m]."""
        return jnp.sum(self.row * q)


class _Belt(eqx.Module):
    """Velocity of a surface."""

    row: Float[Array, " waves"]
    frequencies: Float[Array, " frequencies"]

    def __call__(self, t: Array) -> Array:
        """Its value [m/s]."""
        return jnp.sum(self.row * _waves(t, self.frequencies))


def linear_stick_slip(system: LinearStickSlip, *, moving: bool | None = None) -> Scene:
    """The scene of a `LinearStickSlip`, whose motion `stick_slip_motion` gives.

    Scenes of systems with the same numbers of coordinates, elements, frequencies and samples have the same structure,
    so that their numbers can be stacked for `jax.vmap`.

    **Arguments:**

    - `system`: the `LinearStickSlip`. Belts must not depend on its signal.
    - `moving`: whether surfaces move; by default where `belt` is not zero.

    **Returns:**

    A `Scene` with the coordinates of the system [m] and the effects `load`, `element_0`, `element_1`, ...
    """
    moving = bool(np.any(system.belt)) if moving is None else moving
    frequencies = jnp.asarray(system.frequencies)
    params = {
        "mass": system.mass,
        "stiffness": system.stiffness,
        "damping": system.damping,
        "load": system.load[:, :-2],
        "frequencies": frequencies,
    }
    load = _load
    if len(system.sample_times):
        params["signal"] = Signal(system.sample_times, system.sample_values, linear=system.linear)
        params["signal_load"] = system.load[:, -2]
        load = _load_and_signal
    elements = [
        Friction(
            Coulomb(Fc, Fs),
            along=_Along(jnp.asarray(row)),
            belt_velocity=_Belt(jnp.asarray(belt[:-2]), frequencies) if moving else 0.0,
            name=f"element_{i}",
        )
        for i, (Fc, Fs, row, belt) in enumerate(zip(system.Fc, system.Fs, system.directions, system.belt, strict=True))
    ]
    return Scene(_lagrangian, params=params, effects=(AppliedForce(load, name="load"), *elements))
