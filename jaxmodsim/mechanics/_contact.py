"""Unilateral contact: a gap that opens, closes and strikes."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._core.arguments import as_label
from .._core.functions import as_function
from .._core.parameters import Number, parameter_or
from .._core.position import PositionFn
from .._core.shapes import PerDof, Scalar
from ._constraints import AbstractConstraint, AbstractPositionConstraint, as_at
from ._restitution import HuntCrossley, Poisson

# Rounding units in a gap, of the terms that it is made of.
_ROUNDING = 4.0


class Contact(AbstractPositionConstraint):
    """A unilateral contact `gap(t, q, params) >= 0`: open, closed, or struck at an instant.

    While it is closed the contact is a constraint whose multiplier pushes, >= 0, towards a larger gap, and it opens
    where the multiplier falls to zero. Where the gap closes with the velocity `w < 0`, an impact makes it `-e w`
    (Newton's law of impact, e the coefficient of restitution); where several contacts are struck at one instant, or
    some are closed, the impulses solve `w_i(after) + e_i w_i(before) >= 0`, `impulse_i >= 0`, one of the two zero
    (Moreau 1988). `Poisson` is another law, and `HuntCrossley` makes the contact compliant instead. Impacts that
    accumulate end in a closed contact, where the next rebound, relative to the surface, is lost in rounding. Friction
    by events whose load is the contact takes part in its impacts, by Coulomb's law for the impulses.

    The contacts of a scene stand among its constraints; their modes are 0, open, and 1, closed. Where the gap is a
    length along the normal, the multiplier is the normal force in newtons; `Friction(normal_force=name)` takes it as
    its load.

    **Arguments:**

    - `gap`: `gap(t, q, params)`, one number, not negative at the start. With `at`, `gap(t, x, params)` of the
      position x.
    - `restitution`: coefficient e of Newton's law, 0 to 1; 0 for a landing without bounce. Or `Poisson(e)`, or
      `HuntCrossley(stiffness)`.
    - `at`: `at(q)` or `at(q, params)`, the position [m] of the point of contact; then the normal force is known in
      newtons whatever the unit of the gap.
    - `name`: name in `run.reactions`, `run.mode` and `run.events`, and for `Friction(normal_force=name)`.

    **Raises:**

    - `ValueError` for functions that are none, a restitution out of range, and (at the run) for wrong shapes.

    ??? cite "Reference"

        ```bibtex
        @incollection{moreau1988unilateral,
            author={Moreau, J. J.}, title={Unilateral contact and dry friction in finite freedom dynamics},
            booktitle={Nonsmooth Mechanics and Applications}, series={CISM Courses and Lectures}, number={302},
            publisher={Springer}, pages={1--82}, year={1988},
        }
        ```
    """

    gap: Callable[..., Any] = eqx.field(converter=partial(as_function, name="Contact gap"))
    restitution: Number | Poisson | HuntCrossley = parameter_or(
        "restitution", "", (Poisson, HuntCrossley), lower=0.0, upper=1.0, default=0.0
    )
    at: PositionFn | None = eqx.field(default=None, converter=as_at)
    name: str | None = eqx.field(default=None, static=True, converter=partial(as_label, name="Contact name"))

    stabilise: ClassVar[float] = 0.0

    @property
    def coefficient(self) -> Scalar:
        """Coefficient of restitution by either law of impact; zero of a contact that gives way."""
        law = self.restitution
        if isinstance(law, HuntCrossley):
            return jnp.zeros_like(law.stiffness)
        return law.e if isinstance(law, Poisson) else law

    @property
    def compliant(self) -> HuntCrossley | None:
        """The force of a contact that gives way; None for one with impacts and modes."""
        return self.restitution if isinstance(self.restitution, HuntCrossley) else None

    def value(self, t: Scalar, x: Float[Array, "..."], params: PyTree) -> Float[Array, "..."]:
        """The gap."""
        return self.gap(t, x, params)

    def rounding(self, t: Scalar, q: PerDof, params: PyTree) -> Scalar:
        """Rounding error of the gap, from the coordinates and the time that it is made of; constant."""
        t, q, params = jax.lax.stop_gradient((t, q, params))
        by_t, by_q = jax.grad(lambda t, q: self.error(t, q, params)[0], (0, 1))(t, q)
        return _ROUNDING * float(jnp.finfo(q.dtype).eps) * (jnp.abs(by_t * t) + jnp.sum(jnp.abs(by_q * q)))

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check that the gap is one number."""
        self.check_value(self.gap, "gap of Contact", q, params, name)
        if (shape := jax.eval_shape(self.error, q[0], q, params).shape) != (1,):
            raise ValueError(
                f"Contact {name!r}: gap must return one number, but it returned {shape[0]}. Give each contact a Contact"
                " of its own."
            )


class BoundContact(AbstractConstraint):
    """A contact in a mode: the constraint that it is while `closed` is 1, and none while that is 0."""

    contact: Contact
    closed: Float[Array, ""]
    stabilise: ClassVar[float] = 0.0

    @property
    def name(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of the contact."""
        return self.contact.name

    def error(self, t: Scalar, q: PerDof, params: PyTree) -> Float[Array, "1"]:
        """The gap, or zero."""
        return self.closed * self.contact.error(t, q, params)

    def rate(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, "1"]:
        """The velocity of the gap, or zero."""
        return self.closed * self.contact.rate(t, q, qd, params)

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """As the contact."""
        self.contact.check(q, qd, params, name)

    def force(self, t: Scalar, q: PerDof, params: PyTree, multiplier: Float[Array, "1"]) -> Float[Array, "..."] | None:
        """As the contact; the multiplier is zero while it is open."""
        return self.contact.force(t, q, params, multiplier)

    def per_multiplier(self, t: Scalar, q: PerDof, params: PyTree) -> Scalar:
        """As the contact."""
        return self.contact.per_multiplier(t, q, params)
