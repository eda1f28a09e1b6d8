"""A force from outside."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from ..._core.arguments import as_label
from ..._core.arrays import PerDof, Scalar
from ..._core.functions import as_function, result_shape
from ..._core.position import PositionFn, as_optional_position_fn
from ._effect import AbstractEffect, Action


class AppliedForce(AbstractEffect):
    """A force that is a function, on the coordinates or at a point.

    **Arguments:**

    - `fn`: `fn(t, q, qd, params)` returns the force: without `at` the generalised force, shape `[dof]` [N or N m];
      with `at` a Cartesian force [N] of the shape that `at` returns. Put numbers for derivatives or sweeps into
      `params` (or into the leaves of an `eqx.Module` passed as `fn`).
    - `at`: `at(q)` or `at(q, params)` returns the position of the point of attack [m]; the force is mapped to the
      coordinates by the transposed Jacobian of `at`.
    - `name`: name in `run.forces`.

    **Raises:**

    - `ValueError` if `fn` or `at` is not a function, or (at the run) returns a wrong shape.

    **Example:**

    ```python
    drive = jms.AppliedForce(lambda t, q, qd, p: p["F"] * jnp.ones(1), name="drive")
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2, {"m": 2.0, "F": 4.0}, (drive,))
    print(jms.simulate(scene, [0.0], [0.0], 1.0).qd.round(6), "m/s")
    ```

    ```text
    [[2.]] m/s
    ```
    """

    fn: Callable[..., Any] = eqx.field(converter=partial(as_function, name="AppliedForce fn"))
    at: PositionFn | None = eqx.field(default=None, converter=partial(as_optional_position_fn, name="AppliedForce at"))
    name: str | None = eqx.field(default=None, static=True, converter=partial(as_label, name="AppliedForce name"))

    @property
    def default_name(self) -> str:
        """Name in the results."""
        return "applied"

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check the shape that `fn` returns."""
        given = result_shape(self.fn, t=q[0], q=q, qd=qd, params=params, name=f"fn of AppliedForce {name!r}")
        wanted = q.shape
        if self.at is not None:
            wanted = result_shape(self.at, q=q, params=params, name=f"at of AppliedForce {name!r}")
        if given != wanted:
            where = "the coordinates" if self.at is None else "what `at` returns"
            raise ValueError(
                f"AppliedForce {name!r}: fn returned the shape {given}, but {wanted} is needed (that of {where})."
                " Return jnp.array([...]) with one entry for each."
            )

    def act(self, t: Scalar, q: PerDof, qd: PerDof, z: PyTree, params: PyTree) -> Action:
        """The force, and the generalised force that it makes."""
        force = jnp.asarray(self.fn(t, q, qd, params), q.dtype)
        at = self.at
        if at is None:
            return Action(force, force)
        _, pull = jax.vjp(lambda q: at(q, params), q)
        return Action(pull(force)[0], force)
