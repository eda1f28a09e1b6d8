"""A pressure relief valve whose body strikes its seat, in dimensionless numbers."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxmodsim._core.arrays import PerDof, Scalar
from jaxmodsim.friction import Viscous
from jaxmodsim.mechanics import Contact
from jaxmodsim.scene import AbstractEffect, Action, Friction, Power, Scene

# Damping, precompression of the spring, stiffness of the fluid in the vessel, flow into it, coefficient of restitution.
PARAMS = {"kappa": 1.25, "delta": 10.0, "beta": 20.0, "flow": 5.0, "e": 0.8}


class Pressure(AbstractEffect):
    """The pressure in the vessel, which lifts the valve and escapes through it: `p' = beta (flow - x sqrt(p))`."""

    name: str | None = None

    @property
    def default_name(self) -> str:
        """Name in the results."""
        return "pressure"

    @property
    def stiff(self) -> bool:
        """It swings with the valve."""
        return False

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Nothing to check: it stands in the scene of this problem alone."""

    def initial_state(self, q: PerDof, params: PyTree) -> Scalar:
        """Nine tenths of the pressure that opens the valve."""
        return jnp.asarray(0.9 * params["delta"], q.dtype)

    def act(self, t: Scalar, q: PerDof, qd: PerDof, z: Scalar, params: PyTree) -> Action:
        """Force on the valve, and the rate of the pressure."""
        return Action(jnp.reshape(z, (1,)), z, params["beta"] * (params["flow"] - q[0] * jnp.sqrt(z)))

    def power(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, action: Action) -> Power:
        """All of it comes from outside."""
        return Power(action.force * qd[0])

    def stored_energy(self, z: PyTree) -> float:
        """None: the fluid is not part of the mechanism."""
        return 0.0


class Onset(NamedTuple):
    """Where the open valve begins to swing by itself, for a flow that falls.

    - `lift`: of the valve; `flow`: into the vessel; `frequency`: angular, of the swing.
    """

    lift: Float[Array, ""]
    flow: Float[Array, ""]
    frequency: Float[Array, ""]


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * qd[0] ** 2 - 0.5 * (q[0] + p["delta"]) ** 2


def _lift(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0]


def scene(
    *,
    kappa: ArrayLike = PARAMS["kappa"],
    delta: ArrayLike = PARAMS["delta"],
    beta: ArrayLike = PARAMS["beta"],
    flow: ArrayLike = PARAMS["flow"],
    e: ArrayLike = PARAMS["e"],
) -> Scene:
    """`x'' + kappa x' + x + delta = p` over the seat at x = 0, `p' = beta (flow - x sqrt(p))`.

    The model of G. Licsko, A. Champneys, C. Hos, Dynamical analysis of a hydraulic pressure relief valve, Proceedings
    of the World Congress on Engineering, London, 2009. Below the flow of `onset` it swings, and strikes its seat.

    **Arguments:**

    - `kappa`, `delta`, `beta`: damping, precompression of the spring, stiffness of the fluid, > 0.
    - `flow`: into the vessel, > 0.
    - `e`: coefficient of restitution of the seat, 0 to 1.

    **Returns:**

    A `Scene` with the contact `seat` and the effects `pressure`, whose own state is p, and `damping`.
    """
    return Scene(
        _lagrangian,
        params={"delta": delta, "beta": beta, "flow": flow},
        effects=(Pressure(), Friction(Viscous(kappa), name="damping")),
        constraints=(Contact(_lift, restitution=e, name="seat"),),
        coordinates=("lift [-]",),
    )


def onset(
    *,
    kappa: ArrayLike = PARAMS["kappa"],
    delta: ArrayLike = PARAMS["delta"],
    beta: ArrayLike = PARAMS["beta"],
) -> Onset:
    """The Hopf bifurcation of the open valve at rest, x sqrt(x + delta) = flow.

    Its characteristic polynomial is `s^3 + (kappa + B) s^2 + (1 + kappa B) s + B + C` with
    `B = beta x/(2 sqrt(x + delta))`, `C = beta sqrt(x + delta)`; by Hurwitz two roots are imaginary where
    `(kappa + B)(1 + kappa B) = B + C`, and their square is `-(1 + kappa B)`. Arguments as for `scene`.
    """
    delta, beta = jnp.asarray(delta), jnp.asarray(beta)

    def terms(x: Array) -> tuple[Array, Array]:
        root = jnp.sqrt(x + delta)
        return beta * x / (2.0 * root), beta * root

    low, high = jnp.zeros(()), jnp.asarray(1e3)
    for _ in range(60):
        x = 0.5 * (low + high)
        B, C = terms(x)
        swings = (kappa + B) * (1.0 + kappa * B) < B + C
        low, high = jnp.where(swings, x, low), jnp.where(swings, high, x)
    B, _ = terms(low)
    return Onset(low, low * jnp.sqrt(low + delta), jnp.sqrt(1.0 + kappa * B))
