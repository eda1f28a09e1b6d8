"""Contacts that come in pairs: ends of a range, and the play between two parts."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, PyTree

from .._core.position import PositionFn, ScalarOrFn, as_position_fn, as_scalar_or_fn
from .._core.shapes import PerDof, Scalar
from ._contact import Contact


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
    along: Any, *, lower: Any = None, upper: Any = None, restitution: Any = 0.0, name: str = "stop"
) -> tuple[Contact, ...]:
    """Contacts that keep a displacement within a range, to be added to the constraints of a scene.

    ```python
    scene = jms.Scene(lagrangian, constraints=jms.end_stops(lambda q: q[0], lower=0.0, upper=0.2, restitution=0.3))
    ```

    **Arguments:**

    - `along`: `along(q)` or `along(q, params)`, one number [m or rad].
    - `lower`, `upper`: ends of the range [m or rad], numbers or functions of `params`; None for no stop there.
    - `restitution`: as of `Contact`.
    - `name`: the contacts are called `name_lower` and `name_upper`.

    **Raises:**

    - `ValueError` for no stop at all, and as `Contact`.
    """
    if lower is None and upper is None:
        raise ValueError("end_stops needs lower, upper or both, but none was given: pass lower=0.0, say.")
    given = (("lower", lower, 1.0, -1.0), ("upper", upper, -1.0, 1.0))
    return tuple(
        _contact(along, limit, side, share, restitution, name, "end_stops", end)
        for end, limit, side, share in given
        if limit is not None
    )


def backlash(along: Any, width: Any, *, restitution: Any = 0.0, name: str = "backlash") -> tuple[Contact, ...]:
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

    - As `Contact`.
    """
    return tuple(
        _contact(along, width, side, 0.5, restitution, name, "backlash", end)
        for end, side in (("lower", 1.0), ("upper", -1.0))
    )


def _contact(
    along: Any, limit: Any, side: float, share: float, restitution: Any, name: str, caller: str, end: str
) -> Contact:
    place = as_position_fn(along, name=f"{caller} along")
    stop = _Stop(place, as_scalar_or_fn(limit, name=f"{caller} {end}"), side, share)
    return Contact(stop, restitution=restitution, name=f"{name}_{end}")
