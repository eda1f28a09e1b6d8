"""Contacts that come in pairs: ends of a range, and the play between two parts."""

from typing import Any

import equinox as eqx
import jax.core
import numpy as np
from jaxtyping import Array, PyTree

from .._core.parameters import Default, Range
from .._core.position import PositionFn, ScalarOrFn, as_position_fn, as_scalar_or_fn
from .._core.shapes import PerDof, Scalar
from ._contact import Contact

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
    """Contacts that keep a displacement within a range, to be added to the constraints of a scene.

    ```python
    scene = jms.Scene(lagrangian, constraints=jms.end_stops(lambda q: q[0], lower=0.0, upper=0.2, restitution=0.3))
    ```

    **Arguments:**

    - `along`: `along(q)` or `along(q, params)`, one number [m or rad].
    - `lower`, `upper`: ends of the range [m or rad], lower < upper, finite numbers or functions of `params`; None for
      no stop there.
    - `restitution`: as of `Contact`.
    - `name`: the contacts are called `name_lower` and `name_upper`.

    **Raises:**

    - `ValueError` for no stop at all, for numbers with lower >= upper, and as `Contact`.
    """
    if lower is None and upper is None:
        raise ValueError("end_stops needs lower, upper or both, but none was given: pass lower=0.0, say.")
    finite = Range("m or rad")
    given = tuple(
        (end, as_scalar_or_fn(limit, name=f"end_stops {end}", allowed=finite), side, -side)
        for end, limit, side in (("lower", lower, 1.0), ("upper", upper, -1.0))
        if limit is not None
    )
    amounts = [limit.amount for _, limit, _, _ in given]
    if len(amounts) == 2 and not any(callable(x) or isinstance(x, jax.core.Tracer) for x in amounts):
        least, most = (np.asarray(x) for x in amounts)
        if not least < most:
            raise ValueError(
                f"end_stops needs lower < upper [m or rad], but lower={least:g} and upper={most:g} were given: exchange"
                " them, or leave one out."
            )
    return tuple(_contact(along, *stop, restitution, name, "end_stops") for stop in given)


def backlash(along: Any, width: Any, *, restitution: Any = _NO_BOUNCE, name: str = "backlash") -> tuple[Contact, ...]:
    """Contacts on either side of the play between two parts, such as the teeth of two gears.

    ```python
    scene = jms.Scene(lagrangian, constraints=jms.backlash(lambda q: q[0] - 50.0 * q[1], lambda p: p["play"]))
    ```

    **Arguments:**

    - `along`: `along(q)` or `along(q, params)`: displacement of one part relative to the other [m or rad], zero in the
      middle of the play.
    - `width`: the play [m or rad], > 0: the displacement stays within half of it on either side. A number, which each
      contact then has as its own, or a function of `params`.
    - `restitution`: as of `Contact`.
    - `name`: the contacts are called `name_lower` and `name_upper`.

    **Raises:**

    - `ValueError` for a width that is not positive, and as `Contact`.
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
