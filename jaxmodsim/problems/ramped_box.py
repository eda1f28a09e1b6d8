"""A box on a table, pulled by a force that rises with time: the test bench of friction models.

The box has a mass of 2 kg, and is at rest at t = 0. The force is `ramp * t`, for 10 s (NTNU course TTK4130, exercise 9,
problem 2).
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from ..friction import Coulomb, LuGre, Stribeck
from ..scene import AppliedForce, Friction, Scene

COULOMB = {"Fc": 1.5}
STRIBECK = {"Fc": 1.5, "Fs": 1.75, "vs": 0.2, "Fv": 0.1}
LUGRE = {"sigma0": 750.0, "sigma1": 0.0, "sigma2": 0.1, "Fc": 1.5, "Fs": 1.75, "vs": 0.2}

# Velocity [m/s] and bristle deflection [m] at t = 10 s with LUGRE and a ramp of 1 N/s. Four solvers agree on these
# values at tight tolerances.
LUGRE_V10 = 15.694099521
LUGRE_Z10 = 0.0020000000


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def _pull(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.reshape(p["ramp"] * t, (1,))


def scene(law: object = None, *, ramp: ArrayLike = 1.0, m: ArrayLike = 2.0) -> Scene:
    """Box on a table pulled by the force `ramp * t`.

    **Arguments:**

    - `law`: friction law between box and table; None for no friction.
    - `ramp`: rise of the force [N/s].
    - `m`: mass [kg], > 0.

    **Returns:**

    A `Scene` with one coordinate [m] and the effects `pull` and (with a law) `friction`. Without friction
    `v(t) = v0 + ramp t^2/(2 m)`; with a break-away force `Fs` the box rests until `t = Fs/ramp`.
    """
    friction = () if law is None else (Friction(law),)
    return Scene(
        _lagrangian,
        params={"m": m, "ramp": ramp},
        effects=(AppliedForce(_pull, name="pull"), *friction),
        coordinates=("x [m]",),
    )


def coulomb() -> Coulomb:
    """The Coulomb law of the box.

    **Returns:**

    A `Coulomb` law.
    """
    return Coulomb(**COULOMB)


def stribeck() -> Stribeck:
    """The law of the box with stiction, Stribeck effect and viscous friction.

    **Returns:**

    A `Stribeck` law.
    """
    return Stribeck(**STRIBECK)


def lugre(**changes: ArrayLike) -> LuGre:
    """The LuGre law of the box, with `changes` to its parameters.

    **Returns:**

    A `LuGre` law.
    """
    return LuGre(**{**LUGRE, **changes})
