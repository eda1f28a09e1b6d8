"""A force that changes at events of the user."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PyTree

from ..._core.arguments import as_label
from ..._core.arrays import PerDof, Scalar
from ..._core.functions import as_function, result_shape
from ..._core.parameters import unless_none
from ._effect import AbstractEffect, Action

_force = partial(unless_none, convert=as_function)


class Switch(AbstractEffect):
    """A force that changes when a function of time and state passes through zero, or an event without a force.

    The guard is one event function of the run. Each passage through zero ends a step, is an entry of `run.events`, and
    contributes to derivatives (the saltation matrix), so that derivatives of switching times and thresholds hold, too.
    A `jnp.where` in an `AppliedForce` gives none of these. Both forces are evaluated at all times and must be finite on
    either side. A guard along which both forces push back to zero (sliding mode) ends the run as chatter.

    **Arguments:**

    - `guard`: `guard(t, q, qd, params)` returns one real number, continuous along the motion, in any unit. At the
      start a guard of exactly zero counts by the sign of its rate.
    - `above`, `below`: functions as `guard` that return the generalised force, shape `[dof]` [N or N m], while the
      guard is positive and while it is negative; None for no force.
    - `name`: name in `run.forces`, `run.mode` (1 above, -1 below) and `run.events`.

    **Raises:**

    - `ValueError` if one of these is not a function, or (at the run) returns a wrong shape.

    **Example:**

    ```python
    spring = jms.Switch(lambda t, q, qd, p: q[0], above=lambda t, q, qd, p: -p["k"] * q)  # acts where q[0] > 0
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {"k": 4.0}, (spring,))
    print(jms.simulate(scene, [-1.0], [1.0], 4.0).events.t.round(4), "s")
    ```

    ```text
    [1.     2.5708] s
    ```
    """

    guard: Callable[..., Any] = eqx.field(converter=partial(as_function, name="Switch guard"))
    above: Callable[..., Any] | None = eqx.field(default=None, converter=partial(_force, name="Switch above"))
    below: Callable[..., Any] | None = eqx.field(default=None, converter=partial(_force, name="Switch below"))
    name: str | None = eqx.field(default=None, static=True, converter=partial(as_label, name="Switch name"))

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check the shapes that the functions return."""
        state = {"t": q[0], "q": q, "qd": qd, "params": params}
        for role, fn, wanted in (
            ("guard", self.guard, ()),
            ("above", self.above, q.shape),
            ("below", self.below, q.shape),
        ):
            given = wanted if fn is None else result_shape(fn, **state, name=f"{role} of Switch {name!r}")
            if given != wanted:
                raise ValueError(
                    f"Switch {name!r}: {role} returned the shape {given}, but {wanted} is needed: "
                    + ("one number." if role == "guard" else "one entry for each coordinate.")
                )

    def act(self, t: Scalar, q: PerDof, qd: PerDof, z: PyTree, params: PyTree) -> Action:
        """An error: the force depends on the mode."""
        raise ValueError(
            f"Switch {self.name or self.default_name!r} changes by events, so that position and velocity do not tell"
            " its force: run the scene by jaxmodsim.simulate, with an adaptive solver."
        )

    def act_on(self, side: Scalar, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Action:
        """The force on this side of the guard, 1 above and -1 below; NaN if the guard is NaN."""
        above, below = (
            jnp.zeros_like(q) if fn is None else jnp.asarray(fn(t, q, qd, params), q.dtype)
            for fn in (self.above, self.below)
        )
        # A guard that is NaN has no side: the run ends with an error.
        force = jnp.where(jnp.isnan(self.value(t, q, qd, params)), jnp.nan, jnp.where(side > 0, above, below))
        return Action(force, force)

    def value(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Scalar:
        """The guard, as a number of the type of `q`."""
        return jnp.asarray(self.guard(t, q, qd, params), q.dtype)
