"""Unilateral contacts, which open, close and strike; laws of impact; end stops and backlash."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._core.arguments import as_label
from .._core.arrays import PerDof, Scalar, is_known
from .._core.functions import as_function
from .._core.parameters import AbstractRanged, Default, Number, Range, parameter, parameter_or
from .._core.position import PositionFn, ScalarOrFn, as_optional_position_fn, as_position_fn, as_scalar_or_fn
from .._core.safe import rounding_of, safe_power
from ._constraints import AbstractEquations, AbstractPositionConstraint

# Newton steps to the speed after an impact.
_NEWTON = 10
# Up to this y = 3/2 damping speed, the coefficient of restitution of a compliant contact is its series.
_SMALL = 0.3


def _rebound_series(number: int) -> np.ndarray:
    """Coefficients of `e` in powers of y, the highest first: `w = e y` satisfies `(1 + y) w w' = y (1 - w)`."""
    w, powers = np.eye(number + 1)[1], np.arange(number + 1)
    for k in range(2, number + 1):
        product = np.convolve(w, powers * w)  # y w w', in which w[k] is missing yet
        w[k] = -(product[k + 1] + product[k] + w[k - 1]) / (k + 1)
    return w[:0:-1]


_REBOUND = _rebound_series(32)


class Poisson(AbstractRanged):
    """Poisson's law of impact: a contact returns at least the fraction `e` of its compression impulse in expansion.

    The compression impulses are those of an impact without restitution. Each expansion impulse is at least `e` times
    the compression impulse, and larger if the gap would close otherwise. Closed contacts take part with their own `e`.
    Friction obeys Coulomb's law in each phase, with the slip at the end of the phase.

    Without friction an impact never gains energy, for any coefficients: twice the compression impulses are admissible
    in expansion and restore the energy, and the actual impulses minimize it. With friction the same holds for equal
    coefficients.

    **Arguments:**

    - `e`: coefficient, 0 to 1.

    **Raises:**

    - `ValueError` if `e` is out of range or no number.

    **Example:**

    ```python
    floor = jms.Contact(lambda t, q, p: q[0], restitution=jms.Poisson(0.5))
    print(floor.coefficient)
    ```

    ```text
    0.5
    ```

    ??? cite "Reference"

        ```bibtex
        @book{pfeiffer1996multibody,
            author={Pfeiffer, F. and Glocker, C.}, title={Multibody Dynamics with Unilateral Contacts},
            publisher={Wiley}, year={1996}, note={chapter 8},
        }
        ```
    """

    e: Number = parameter("e", "", lower=0.0, upper=1.0)


class HuntCrossley(AbstractRanged):
    """A compliant contact with the force `k d^n (1 + 3/2 damping d')` at the penetration d > 0, but never a pull.

    The contact has no impacts and no modes. A body that strikes at the speed v leaves at `restitution(v) v`, where the
    coefficient is about `1 - damping v`. The duration of contact scales as `stiffness**(-1/(n + 1))`, and so does the
    difference to a rigid contact with that coefficient. The contact stores the energy `k d^(n + 1)/(n + 1)`.

    **Arguments:**

    - `stiffness`: k [N/m^n], > 0.
    - `exponent`: n, >= 1; 3/2 for spheres (Hertz).
    - `damping`: [s/m], >= 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    **Example:**

    ```python
    law = jms.HuntCrossley(stiffness=1e8, damping=0.2)
    floor = jms.Contact(lambda t, q, p: q[0], restitution=law)
    print(f"{law.force(jnp.array(1e-4), jnp.array(0.0)):.1f} N, e = {law.restitution(0.5):.3f} at 0.5 m/s")
    ```

    ```text
    100.0 N, e = 0.909 at 0.5 m/s
    ```

    ??? cite "Reference"

        ```bibtex
        @article{hunt1975coefficient,
            author={Hunt, K. H. and Crossley, F. R. E.},
            title={Coefficient of restitution interpreted as damping in vibroimpact},
            journal={Journal of Applied Mechanics}, volume={42}, number={2}, pages={440--445}, year={1975},
        }
        ```
    """

    stiffness: Number = parameter("stiffness", "N/m^n", lower=0.0, strict=True)
    exponent: Number = parameter("exponent", "", lower=1.0, default=1.5)
    damping: Number = parameter("damping", "s/m", lower=0.0, default=0.0)

    def force(self, depth: Scalar, rate: Scalar) -> Scalar:
        """Force [N] at the penetration `depth` [m] and its rate [m/s]; zero if the contact is open."""
        elastic = self.stiffness * safe_power(jnp.maximum(depth, 0.0), self.exponent)
        return elastic * jnp.maximum(1.0 + 1.5 * self.damping * rate, 0.0)

    def stored_energy(self, depth: Scalar) -> Scalar:
        """Energy [J] stored at the penetration `depth` [m]."""
        power = self.exponent + 1.0
        return self.stiffness * safe_power(jnp.maximum(depth, 0.0), power) / power

    def restitution(self, speed: Float[Array, ""] | float) -> Float[Array, ""]:
        """Coefficient of restitution of a single body that strikes at `speed` [m/s], > 0.

        With `y = 3/2 damping speed` it solves `(1 + e) y = log((1 + y)/(1 - e y))`, for any mass, k and n.
        """
        y = 1.5 * self.damping * speed
        small = y < _SMALL
        large = jnp.where(small, _SMALL, y)
        c = jnp.minimum(1.0 + large - jnp.log1p(large), 60.0)  # u - log(u) = c for u = 1 - e y, from below

        def step(_: object, u: Array) -> Array:
            return u + (u - jnp.log(u) - c) * u / (1.0 - u)

        u = jax.lax.stop_gradient(jax.lax.fori_loop(0, _NEWTON, step, jnp.exp(-c)))
        u = step(0, step(0, u))  # the first step has the first derivative, the second one the second
        return jnp.where(small, jnp.polyval(_REBOUND, jnp.where(small, y, 0.0)), (1.0 - u) / large)


class Contact(AbstractPositionConstraint):
    """A unilateral contact `gap(t, q, params) >= 0` that is open or closed, with impacts.

    A closed contact is a constraint with a multiplier >= 0, which pushes towards a larger gap; it opens when the
    multiplier falls to zero. If the gap closes with the velocity `w < 0`, an impact changes the velocity to `-e w`
    (Newton's law of impact, with the coefficient of restitution e). For simultaneous impacts, or impacts while other
    contacts are closed, the impulses solve `w_i(after) + e_i w_i(before) >= 0`, `impulse_i >= 0`, one of the two zero
    (Moreau 1988). `Poisson` is another law, and `HuntCrossley` makes the contact compliant. A series of accumulating
    impacts ends in a closed contact when rounding hides the next rebound. Event-driven friction under the load of the
    contact takes part in its impacts, by Coulomb's law for the impulses.

    The contacts of a scene belong to its constraints; their modes are 0, open, and 1, closed. If the gap is a length
    along the normal, the multiplier is the normal force in newtons, which `Friction(normal_force=name)` uses as its
    load.

    **Arguments:**

    - `gap`: `gap(t, q, params)`, one number, not negative at the start. With `at`, `gap(t, x, params)` of the
      position x.
    - `restitution`: coefficient e of Newton's law, 0 to 1; 0 for an impact without rebound. Or `Poisson(e)`, or
      `HuntCrossley(stiffness)`.
    - `at`: `at(q)` or `at(q, params)`, the position [m] of the point of contact; the normal force is then in newtons
      for any unit of the gap.
    - `name`: name in `run.reactions`, `run.mode` and `run.events`, and for `Friction(normal_force=name)`.

    **Raises:**

    - `ValueError` if an argument is not a function or out of range, and (in the run) for wrong shapes.

    **Example:**

    ```python
    floor = jms.Contact(lambda t, q, p: q[0], restitution=0.5, name="floor")
    ball = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 9.81 * q[0], constraints=(floor,))
    print(jms.simulate(ball, [1.0], [0.0], 1.0).events.t.round(3))
    ```

    ```text
    [0.452 0.903]
    ```

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
    at: PositionFn | None = eqx.field(default=None, converter=partial(as_optional_position_fn, name="Constraint at"))
    name: str | None = eqx.field(default=None, static=True, converter=partial(as_label, name="Contact name"))

    stabilise: ClassVar[float] = 0.0

    @property
    def coefficient(self) -> Scalar:
        """Coefficient of restitution of both laws of impact; zero for a compliant contact."""
        law = self.restitution
        if isinstance(law, HuntCrossley):
            return jnp.zeros_like(law.stiffness)
        return law.e if isinstance(law, Poisson) else law

    @property
    def compliant(self) -> HuntCrossley | None:
        """The law of a compliant contact; None for a contact with impacts and modes."""
        return self.restitution if isinstance(self.restitution, HuntCrossley) else None

    def value(self, t: Scalar, x: Float[Array, "..."], params: PyTree) -> Float[Array, "..."]:
        """The gap."""
        return self.gap(t, x, params)

    def rounding(self, t: Scalar, q: PerDof, params: PyTree) -> Scalar:
        """Rounding error of the gap due to coordinates and time, without derivatives."""
        params = jax.lax.stop_gradient(params)
        return rounding_of(lambda t, q: self.error(t, q, params)[0], t, q)

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check that the gap is one number."""
        self.check_value(self.gap, "gap of Contact", q, params, name)
        if (shape := jax.eval_shape(self.error, q[0], q, params).shape) != (1,):
            raise ValueError(
                f"Contact {name!r}: gap must return one number, but it returned {shape[0]}. Define one Contact for each"
                " gap."
            )


class BoundContact(AbstractEquations):
    """A contact in a mode: an equation if `closed` is 1, without effect if it is 0."""

    contact: Contact
    closed: Float[Array, ""]
    stabilise: ClassVar[float] = 0.0

    def error(self, t: Scalar, q: PerDof, params: PyTree) -> Float[Array, "1"]:
        """The gap; zero if the contact is open."""
        return self.closed * self.contact.error(t, q, params)

    def rate(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, "1"]:
        """The velocity of the gap; zero if the contact is open."""
        return self.closed * self.contact.rate(t, q, qd, params)


_NO_BOUNCE = Default(0.0)


class _Stop(eqx.Module):
    """The gap `side along(q) + share limit` of a stop."""

    along: PositionFn
    limit: ScalarOrFn
    side: float = eqx.field(static=True)
    share: float = eqx.field(static=True)

    def __call__(self, t: Scalar, q: PerDof, params: PyTree) -> Array:
        """The gap."""
        return self.side * self.along(q, params) + self.share * self.limit(params)


def end_stops(
    along: Any, *, lower: Any = None, upper: Any = None, restitution: Any = _NO_BOUNCE, name: str = "stop"
) -> tuple[Contact, ...]:
    """Contacts that keep a displacement within a range, for the constraints of a scene.

    **Arguments:**

    - `along`: `along(q)` or `along(q, params)`, one number [m or rad].
    - `lower`, `upper`: ends of the range [m or rad], lower < upper, finite numbers or functions of `params`; None for
      no stop at that end.
    - `restitution`: as in `Contact`.
    - `name`: prefix of the names `name_lower` and `name_upper` of the contacts.

    **Returns:**

    A contact for each end, the lower one first, for `Scene(constraints=...)`.

    **Raises:**

    - `ValueError` if both ends are None, if lower >= upper, for a name that is not a text, and as `Contact`.

    **Example:**

    ```python
    stops = jms.end_stops(lambda q: q[0], lower=0.0, upper=0.2, restitution=0.3)
    print([contact.name for contact in stops])
    ```

    ```text
    ['stop_lower', 'stop_upper']
    ```
    """
    if lower is None and upper is None:
        raise ValueError("end_stops needs lower, upper or both, but none was given: pass lower=0.0, for example.")
    finite = Range("m or rad")
    stops = tuple(
        (end, as_scalar_or_fn(limit, name=f"end_stops {end}", allowed=finite), side, -side)
        for end, limit, side in (("lower", lower, 1.0), ("upper", upper, -1.0))
        if limit is not None
    )
    amounts = [limit.amount for _, limit, _, _ in stops]
    if len(amounts) == 2 and is_known(*amounts) and not any(map(callable, amounts)):
        least, most = (np.asarray(x) for x in amounts)
        if not least < most:
            raise ValueError(
                f"end_stops needs lower < upper [m or rad], but lower={least:g} and upper={most:g} were given: swap"
                " them, or omit one."
            )
    return tuple(_contact(along, *stop, restitution, name, "end_stops") for stop in stops)


def backlash(along: Any, width: Any, *, restitution: Any = _NO_BOUNCE, name: str = "backlash") -> tuple[Contact, ...]:
    """Contacts on both sides of the play between two parts, such as the teeth of two gears.

    **Arguments:**

    - `along`: `along(q)` or `along(q, params)`: displacement of one part relative to the other [m or rad], zero in the
      middle of the play.
    - `width`: the play [m or rad], > 0: the displacement stays within half of it on both sides. A number, of which each
      contact holds a copy, or a function of `params`.
    - `restitution`: as in `Contact`.
    - `name`: prefix of the names `name_lower` and `name_upper` of the contacts.

    **Returns:**

    The contacts at the lower and the upper end, for `Scene(constraints=...)`.

    **Raises:**

    - `ValueError` for a width that is not positive, a name that is not a text, and as `Contact`.

    **Example:**

    ```python
    teeth = jms.backlash(lambda q: q[0] - 50.0 * q[1], lambda p: p["play"])
    print([contact.name for contact in teeth])
    ```

    ```text
    ['backlash_lower', 'backlash_upper']
    ```
    """
    play = as_scalar_or_fn(width, name="backlash width", allowed=Range("m or rad", 0.0, strict=True))
    return tuple(
        _contact(along, end, play, side, 0.5, restitution, name, "backlash")
        for end, side in (("lower", 1.0), ("upper", -1.0))
    )


def _contact(
    along: Any, end: str, limit: ScalarOrFn, side: float, share: float, restitution: Any, name: object, caller: str
) -> Contact:
    if not (isinstance(name, str) and name):
        raise ValueError(f"{caller} name must be a text that is not empty, but {name!r} was given.")
    place = as_position_fn(along, name=f"{caller} along")
    return Contact(_Stop(place, limit, side, share), restitution=restitution, name=f"{name}_{end}")
