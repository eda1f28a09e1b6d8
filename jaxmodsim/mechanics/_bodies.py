"""Lagrangians of bodies whose position is a function of the coordinates."""

import abc
from collections.abc import Callable
from functools import partial, reduce
from operator import add
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._core.arguments import as_label
from .._core.arrays import PerDof, Scalar, is_known
from .._core.cholesky import solve_balanced
from .._core.functions import as_function
from .._core.parameters import Default, Range
from .._core.position import PositionFn, ScalarOrFn, as_position_fn, as_scalar_or_fn
from .._core.safe import safe_norm
from .._core.trace_checks import check_indices

_MASS, _INERTIA, _GRAVITY = Range("kg", 0.0, strict=True), Range("kg m^2"), Range("m/s^2")
_ON_EARTH = Default(9.81)
# Fraction of the largest moment of inertia that counts as rounding.
_ROUNDING = 1e-6


class AbstractBody(eqx.Module):
    """A Lagrangian that can be added to others: `bead + rod + spring`, the last any function `L(t, q, qd, params)`."""

    @abc.abstractmethod
    def __call__(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Scalar:
        """Lagrangian [J]."""

    def __add__(self, other: Any) -> "Bodies":
        """The sum of both; a sum of sums has their parts side by side."""
        return _sum(self, other)

    def __radd__(self, other: Any) -> "AbstractBody":
        """The sum of both; `sum` starts from zero, which adds nothing."""
        return self if other == 0 else _sum(other, self)


class Bodies(AbstractBody):
    """A sum of Lagrangians, by name; `gravity` is that of all bodies, where each has the same number."""

    parts: dict[str, Callable[..., Any]]
    gravity: ScalarOrFn | None

    def __call__(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Scalar:
        """Sum of the Lagrangians [J]."""
        return reduce(add, (part(t, q, qd, params) for _, part in sorted(self.alone().items())))

    def alone(self) -> dict[str, Callable[..., Any]]:
        """The terms, each body with its gravity."""
        return self.parts if self.gravity is None else _in_gravity(self.parts, self.gravity)


def _sum(*terms: Any) -> Bodies:
    """The sum; of terms with one name, the second is called `name_2`."""
    parts: dict[str, Callable[..., Any]] = {}
    for term in terms:
        added = as_function(term, name="The term added to a body")
        for name, part in added.alone().items() if isinstance(added, Bodies) else [(_name(term), added)]:
            names = (name, *(f"{name}_{i}" for i in range(2, len(parts) + 2)))
            parts[next(each for each in names if each not in parts)] = part
    own: list[Any] = [x.gravity.amount for x in parts.values() if isinstance(x, PointMass | RigidBody)]
    one = bool(own) and all(is_known(x) and x == own[0] for x in own)
    return Bodies(_in_gravity(parts, None), ScalarOrFn(own[0])) if one else Bodies(parts, None)


def _in_gravity(parts: dict[str, Any], gravity: ScalarOrFn | None) -> dict[str, Any]:
    """`parts` whose bodies have this gravity."""
    put = partial(eqx.tree_at, lambda body: body.gravity, replace=gravity, is_leaf=lambda x: x is None)
    return {name: put(x) if isinstance(x, PointMass | RigidBody) else x for name, x in parts.items()}


def _name(term: Any) -> str:
    if isinstance(term, PointMass | RigidBody):
        return term.name or ("point_mass" if isinstance(term, PointMass) else "rigid_body")
    name = getattr(term, "__name__", type(term).__name__)
    return name if name.isidentifier() else "term"


class PointMass(AbstractBody):
    """Lagrangian of a point mass, from `point_mass`."""

    m: ScalarOrFn = eqx.field(converter=partial(as_scalar_or_fn, name="point_mass m", allowed=_MASS))
    position: PositionFn = eqx.field(converter=partial(as_position_fn, name="point_mass position"))
    gravity: ScalarOrFn = eqx.field(converter=partial(as_scalar_or_fn, name="point_mass gravity", allowed=_GRAVITY))
    name: str | None = eqx.field(static=True, converter=partial(as_label, name="point_mass name"))

    def __call__(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Scalar:
        """`m v^2/2 - m g z` [J]."""
        x, v = _moving(self.position, q, qd, params, "point_mass")
        m = self.m(params)
        return 0.5 * m * jnp.sum(v**2) - m * self.gravity(params) * x[2]

    def reaction(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, "3"]:
        """Normal force [N] of the path or surface on the mass, from curvature and gravity, shape `[3]`.

        It is the normal part of `m (d2x/dt2 + g ez)`, which does not depend on accelerations along the path. Subtract
        the normal components of other forces on the mass, which the Lagrangian does not contain.
        """
        _check_indices(self.position, q, params)

        def velocity(q: Array) -> Array:
            return jax.jvp(lambda q: self.position(q, params), (q,), (qd,))[1]

        curved = jax.jvp(velocity, (q,), (qd,))[1]
        up = jnp.zeros_like(curved).at[2].set(self.gravity(params))
        load = self.m(params) * (curved + up)
        tangents = jnp.moveaxis(jax.jacfwd(lambda q: self.position(q, params))(q), 1, 0)
        gram = jnp.sum(tangents[:, None, :] * tangents[None, :, :], axis=2)
        along = jnp.sum(tangents * load[None, :], axis=1)
        share = solve_balanced(gram, along)
        return load - jnp.sum(tangents * share[:, None], axis=0)

    def normal_force(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Scalar:
        """Magnitude [N] of `reaction`, for `Friction(normal_force=bead.normal_force)`."""
        return safe_norm(self.reaction(t, q, qd, params))


def point_mass(m: Any, position: Any, gravity: Any = _ON_EARTH, name: str | None = None) -> PointMass:
    """Lagrangian of a point mass whose position is a function of the coordinates.

    Bodies add up: `jms.point_mass(...) + jms.rigid_body(...) + spring`, with `spring(t, q, qd, params)` any Lagrangian.

    **Arguments:**

    - `m`: mass [kg], > 0, or a function `m(params)`, so that several functions can share a number in `params`.
    - `position`: `position(q)` or `position(q, params)` in space [m], shape `[3]`, z upwards.
    - `gravity`: acceleration [m/s^2] along -z, or a function of `params`; by default 9.81. A sum of bodies with the
      same number has one, `lagrangian.gravity`.
    - `name`: in a sum of bodies, the numbers of this one are `lagrangian.parts.NAME.m` and so on; by default
      "point_mass", and "point_mass_2" for the second.

    **Returns:**

    A function `L(t, q, qd, params)` [J] with the methods `reaction` and `normal_force`, the force of a path or surface
    on the mass. Its numbers are leaves of the scene.

    **Raises:**

    - `ValueError` if an argument is neither a number nor a function, for an empty `name`, and (in the run) if
      `position` returns another shape or uses an index out of range.

    **Example:**

    ```python
    bead = jms.point_mass(0.1, lambda q: 0.3 * jnp.stack([jnp.sin(q[0]), 0.0 * q[0], -jnp.cos(q[0])]))
    scene = jms.Scene(bead)
    print(f"{bead(jnp.array(0.0), jnp.zeros(1), jnp.ones(1), {}):.4f} J")
    ```

    ```text
    0.2988 J
    ```
    """
    return PointMass(m, position, gravity, name)


def _inertia(value: object) -> ScalarOrFn:
    inertia = as_scalar_or_fn(value, name="rigid_body inertia", allowed=_INERTIA, array=True)
    if callable(inertia.amount) or not is_known(inertia.amount):
        return inertia
    known = np.asarray(inertia.amount)
    rounding = _ROUNDING * np.abs(known).max(initial=0.0)
    tensor = known.shape == (3, 3)
    if tensor and np.abs(known - known.T).max() > rounding:
        raise ValueError(f"rigid_body inertia must be symmetric, but {known.tolist()} was given.")
    if (moments := np.linalg.eigvalsh(known) if tensor else known).min(initial=0.0) < -rounding * tensor:
        raise ValueError(f"rigid_body inertia must have moments >= 0 [kg m^2], but they are {moments.tolist()}.")
    return inertia


class RigidBody(AbstractBody):
    """Lagrangian of a rigid body, from `rigid_body`."""

    m: ScalarOrFn = eqx.field(converter=partial(as_scalar_or_fn, name="rigid_body m", allowed=_MASS))
    inertia: ScalarOrFn = eqx.field(converter=_inertia)
    position: PositionFn = eqx.field(converter=partial(as_position_fn, name="rigid_body position"))
    orientation: PositionFn = eqx.field(converter=partial(as_position_fn, name="rigid_body orientation"))
    gravity: ScalarOrFn = eqx.field(converter=partial(as_scalar_or_fn, name="rigid_body gravity", allowed=_GRAVITY))
    name: str | None = eqx.field(static=True, converter=partial(as_label, name="rigid_body name"))

    def __call__(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Scalar:
        """`m v^2/2 + w I w/2 - m g z` [J]."""
        x, v = _moving(self.position, q, qd, params, "rigid_body")
        m, inertia = self.m(params), jnp.asarray(self.inertia(params))
        _check_indices(self.orientation, q, params)
        turn, rate = jax.jvp(lambda q: self.orientation(q, params), (q,), (qd,))
        _check_orientation(turn.shape, inertia.shape)
        if turn.ndim == 0:
            spin = 0.5 * inertia * rate**2
        else:
            w = body_rates(turn, rate)
            momentum = inertia * w if inertia.ndim < 2 else jnp.sum(inertia * w[None, :], axis=1)
            spin = 0.5 * jnp.sum(w * momentum)
        return 0.5 * m * jnp.sum(v**2) + spin - m * self.gravity(params) * x[2]


def rigid_body(
    m: Any, inertia: Any, position: Any, orientation: Any, gravity: Any = _ON_EARTH, name: str | None = None
) -> RigidBody:
    """Lagrangian of a rigid body, from the motion of its centre of mass and of a body-fixed frame.

    **Arguments:**

    - `m`: mass [kg], > 0, or `m(params)`.
    - `inertia`: moments of inertia [kg m^2] about the centre of mass, >= 0, or a function of `params`. For an angle,
      the moment about its axis; for a matrix, the principal moments along the axes of the body frame, shape `[3]`, or
      the symmetric tensor in that frame, shape `[3, 3]`.
    - `position`: `position(q)` or `position(q, params)` of the centre of mass [m], shape `[3]`, z upwards.
    - `orientation`: `orientation(q)` or `orientation(q, params)`: the rotation matrix, shape `[3, 3]`, with the axes of
      the body frame as columns; or, for plane motion, the angle [rad] about a fixed axis.
    - `gravity`, `name`: see `point_mass`.

    **Returns:**

    A function `L(t, q, qd, params)` [J], which can be added to others, see `point_mass`.

    **Raises:**

    - `ValueError` if an argument is neither a number nor a function, and (in the run) for wrong shapes and for indices
      out of range.

    **Example:**

    ```python
    def center(q):  # of a rod of 1 m, hinged at its end
        return 0.5 * jnp.stack([jnp.sin(q[0]), 0.0 * q[0], -jnp.cos(q[0])])

    rod = jms.rigid_body(2.0, 2.0 / 12.0, center, orientation=lambda q: q[0])
    equations = jms.mechanics.motion_equations(rod, jnp.array(0.0), jnp.zeros(1), jnp.zeros(1), {})
    print(equations.mass.round(4))  # m l^2/3
    ```

    ```text
    [[0.6667]]
    ```
    """
    return RigidBody(m, inertia, position, orientation, gravity, name)


def body_rates(turn: Float[Array, "3 3"], rate: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Angular velocity [rad/s] of a frame in its own components, from its rotation matrix and the matrix rate."""
    skew = jnp.sum(turn[:, :, None] * rate[:, None, :], axis=0)
    return 0.5 * jnp.stack([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]])


def _moving(position: PositionFn, q: Array, qd: Array, params: PyTree, owner: str) -> tuple[Array, Array]:
    _check_indices(position, q, params)
    x, v = jax.jvp(lambda q: position(q, params), (q,), (qd,))
    if x.shape != (3,):
        raise ValueError(
            f"{owner}: position returned the shape {x.shape}, but (3,) is needed: x, y, z [m], with z upwards. For"
            " horizontal plane motion set z to zero."
        )
    return x, v


def _check_indices(place: PositionFn, q: Array, params: PyTree) -> None:
    """Refuse indices out of range if a body is called directly; a scene checks its whole Lagrangian."""
    if is_known(q):
        check_indices(place, q, params, name=place.name)


def _check_orientation(turn: tuple[int, ...], inertia: tuple[int, ...]) -> None:
    allowed = {(): [()], (3, 3): [(), (3,), (3, 3)]}
    if turn not in allowed or inertia not in allowed[turn]:
        raise ValueError(
            f"rigid_body: orientation returned the shape {turn} with an inertia of shape {inertia}, but an angle ()"
            " with one moment of inertia (), or a matrix (3, 3) with an inertia of shape (3,) or (3, 3) is needed."
        )
