"""Coordinates in space and the orthonormal frame that goes with them, by differentiation of the position alone."""

import abc
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._core.functions import as_function
from .._core.parameters import as_real
from .._core.safe import safe_norm
from .._core.trace_checks import check_indices
from ._frame import is_right_handed, orthonormal_frame, resolve

_Triples: TypeAlias = ArrayLike | Sequence[Any]


class AbstractChart(eqx.Module):
    """Three coordinates q for a point in space, and the orthonormal frame that travels with it.

    A chart says only where the point is. The tangents `d position/dq_i`, in the order of the coordinates, are made
    orthonormal by Gram-Schmidt: e_1 along the first tangent, e_2 in the plane of the first two, e_3 normal to it, each
    on the side of its own tangent. For orthogonal coordinates they are the unit tangents. The order of the coordinates
    decides whether the frame is right-handed.

    Lengths are in metres. Every method takes leading batch axes, works under `jax.jit`, `jax.vmap` and derivatives,
    and keeps the floating dtype; integers become floating.

    **Poles.** Where exactly one tangent is zero, its direction is missing and the cross product of the other two
    completes a right-handed frame; values and derivatives stay finite, and `scale_factors` has the derivative zero
    there. Where more than one is zero, or the tangents are linearly dependent to rounding, there is no frame:
    `basis`, `right_handed`, `angular_velocity`, `velocity` and `acceleration` raise; `position`, `jacobian` and
    `scale_factors` do not.

    **Raises:**

    - `ValueError` from every method if q has not the shape `[..., 3]`, or qd or qdd not the shape of q.
    - `RuntimeError` at run time, by `equinox.error_if`, where there is no frame; one such point in a batch is enough.
    """

    @abc.abstractmethod
    def position(self, q: _Triples) -> Float[Array, "... 3"]:
        """Cartesian coordinates (x, y, z) [m] of the point at `q`; both have the shape `[..., 3]`."""

    def jacobian(self, q: _Triples) -> Float[Array, "... 3 3"]:
        """Derivative `d position_i/dq_j`, shape `[..., 3, 3]`: the tangents are its columns [m per unit of q_j]."""
        return _batched(_jacobian, "(n)->(n,n)", self, q=q)

    def scale_factors(self, q: _Triples) -> Float[Array, "... 3"]:
        """Lengths of the tangents, `h_i = |d position/dq_i|`, shape `[..., 3]` [m per unit of q_i], never negative."""
        return _batched(_scale_factors, "(n)->(n)", self, q=q)

    def basis(self, q: _Triples) -> Float[Array, "... 3 3"]:
        """Unit vectors of the frame: column i of `[..., 3, 3]` is e_i in Cartesian components.

        Where the frame is right-handed, this is the rotation matrix from the frame to the fixed axes: `basis @ a` has
        the Cartesian components of a vector whose components in the frame are `a`.
        """
        return _batched(_basis, "(n)->(n,n)", self, q=q)

    def right_handed(self, q: _Triples) -> Bool[Array, "..."]:
        """Whether `e_1 x e_2 = e_3` (otherwise it is -e_3), shape `[...]`."""
        return _batched(_right_handed, "(n)->()", self, q=q)

    def angular_velocity(self, q: _Triples, qd: _Triples) -> Float[Array, "... 3"]:
        """Angular velocity w of the frame relative to the fixed axes, in components of the frame.

        `d e_i/dt = w x e_i`, positive by the right-hand rule, for left-handed frames as well.

        Close to a pole all digits are kept in `Cylindrical`, `Spherical` and every chart whose short tangent is the
        last. One that is followed by tangents of changing direction leaves roundings that grow as the inverse of its
        length, here and in derivatives of `basis`: give its coordinate the last place.

        **Arguments:**

        - `q`: coordinates, shape `[..., 3]`.
        - `qd`: their rates, shape of q [unit of q_i per second].

        **Returns:**

        (w . e_1, w . e_2, w . e_3), shape `[..., 3]` [rad/s].
        """
        return _batched(_angular_velocity, "(n),(n)->(n)", self, q=q, qd=qd)

    def velocity(self, q: _Triples, qd: _Triples) -> Float[Array, "... 3"]:
        """Velocity of the point relative to the fixed axes, in components of the frame.

        **Arguments:**

        - `q`: coordinates, shape `[..., 3]`.
        - `qd`: their rates, shape of q [unit of q_i per second].

        **Returns:**

        (v . e_1, v . e_2, v . e_3), shape `[..., 3]` [m/s]; `h_i qd_i` for orthogonal coordinates.
        """
        return _batched(_velocity, "(n),(n)->(n)", self, q=q, qd=qd)

    def acceleration(self, q: _Triples, qd: _Triples, qdd: _Triples) -> Float[Array, "... 3"]:
        """Acceleration of the point relative to the fixed axes, in components of the frame.

        `a = J qdd + (dJ/dt) qd` with the Jacobian J: centripetal and Coriolis terms are contained.

        **Arguments:**

        - `q`: coordinates, shape `[..., 3]`.
        - `qd`, `qdd`: their first and second derivatives in time, shape of q.

        **Returns:**

        (a . e_1, a . e_2, a . e_3), shape `[..., 3]` [m/s^2].
        """
        return _batched(_acceleration, "(n),(n),(n)->(n)", self, q=q, qd=qd, qdd=qdd)


class Cylindrical(AbstractChart):
    """Cylindrical coordinates (r, theta, z): `x = r cos(theta)`, `y = r sin(theta)`; r and z [m], theta [rad].

    For r >= 0 the frame is (e_r, e_theta, e_z), right-handed; scale factors (1, r, 1); angular velocity (0, 0, theta').

    On the axis, r = 0, the tangent along theta vanishes; e_theta is completed to `e_z x e_r`. For r < 0 that tangent
    points backwards, and e_theta with it: the frame is left-handed.
    """

    def position(self, q: _Triples) -> Float[Array, "... 3"]:
        """(r cos(theta), r sin(theta), z) [m], shape `[..., 3]`."""
        r, theta, z = _components(q)
        return jnp.stack([r * jnp.cos(theta), r * jnp.sin(theta), z], axis=-1)


class Spherical(AbstractChart):
    """Spherical coordinates (r, phi, theta), phi from the +z axis and theta about it; r [m], phi and theta [rad].

    `x = r sin(phi) cos(theta)`, `y = r sin(phi) sin(theta)`, `z = r cos(phi)`. For r > 0 and 0 <= phi <= pi the frame
    is (e_r, e_phi, e_theta), right-handed; scale factors (1, r, r sin(phi)); angular velocity
    (cos(phi) theta', -sin(phi) theta', phi').

    At the pole, phi = 0, the tangent along theta vanishes; e_theta is completed to `e_r x e_phi`, which depends on
    theta, and all of the above holds. (At phi = pi a floating sine is not zero, so no tangent vanishes.) At r = 0
    there is no frame. For sin(phi) < 0 the tangent along theta points backwards, and e_theta with it: the frame is
    left-handed. For r < 0 e_phi and e_theta both turn round.
    """

    def position(self, q: _Triples) -> Float[Array, "... 3"]:
        """(r sin(phi) cos(theta), r sin(phi) sin(theta), r cos(phi)) [m], shape `[..., 3]`."""
        r, phi, theta = _components(q)
        radius = r * jnp.sin(phi)
        return jnp.stack([radius * jnp.cos(theta), radius * jnp.sin(theta), r * jnp.cos(phi)], axis=-1)


class Chart(AbstractChart):
    """Coordinates of your own, orthogonal or not, right- or left-handed.

    A tangent counts as vanishing only where it is exactly zero.

    **Arguments:**

    - `position`: `position(q)` returns the Cartesian coordinates [m] as an array of shape `[3]` for q of shape `[3]`;
      a pure JAX function. Numbers that are to be differentiated or swept belong into the leaves of an `eqx.Module`
      passed as `position`.

    **Raises:**

    - `ValueError` if `position` is no function or uses an index beyond the three coordinates, or (from every method)
      returns anything but three real numbers.
    """

    function: Callable[..., Any]

    def __init__(self, position: Any) -> None:
        self.function = as_function(position, name="Chart position")
        check_indices(self.function, jax.ShapeDtypeStruct((3,), jnp.result_type(float)), name="Chart position")

    def position(self, q: _Triples) -> Float[Array, "... 3"]:
        """What the given function returns [m], shape `[..., 3]`."""

        def point(q: Array) -> Array:
            given = self.function(q)
            if getattr(given, "shape", None) != (3,) or not jnp.issubdtype(given.dtype, jnp.floating):
                what = f"{given.dtype}{list(given.shape)}" if hasattr(given, "shape") else f"a {type(given).__name__}"
                raise ValueError(
                    f"Chart: position(q) must return a floating array of shape [3], but for q of shape [3] it returned"
                    f" {what}. Return jnp.stack([x, y, z])."
                )
            return jnp.asarray(given)

        return jnp.vectorize(point, signature="(n)->(n)")(*_checked(q=q))


def _checked(**given: _Triples) -> list[Array]:
    """Arrays of one floating dtype and one shape `[..., 3]`, the first being q."""
    arrays = {
        # A list may hold numbers that are traced.
        name: as_real(jnp.asarray(value) if isinstance(value, list | tuple) else value, name=name)
        for name, value in given.items()
    }
    shape = arrays["q"].shape
    if shape[-1:] != (3,):
        raise ValueError(
            f"q must have the shape [..., 3], one entry for each of the three coordinates, but has the shape"
            f" {list(shape)}. Coordinates of many points go along leading axes."
        )
    for name, array in arrays.items():
        if array.shape != shape:
            raise ValueError(f"{name} must have the shape of q, {list(shape)}, but has the shape {list(array.shape)}.")
    dtype = jnp.result_type(*arrays.values())
    return [array.astype(dtype) for array in arrays.values()]


def _components(q: _Triples) -> list[Array]:
    (array,) = _checked(q=q)
    return [array[..., i] for i in range(3)]


def _batched(point: Callable[..., Array], signature: str, chart: AbstractChart, **given: _Triples) -> Array:
    """Apply `point(chart, q, ...)`, written for one point, along all leading axes."""
    return _compiled(point, signature, chart, *_checked(**given))


@eqx.filter_jit
def _compiled(point: Callable[..., Array], signature: str, chart: AbstractChart, *arrays: Array) -> Array:
    return jnp.vectorize(partial(point, chart), signature=signature)(*arrays)


def _jacobian(chart: AbstractChart, q: Float[Array, "3"]) -> Float[Array, "3 3"]:
    return jax.jacfwd(chart.position)(q)


def _scale_factors(chart: AbstractChart, q: Float[Array, "3"]) -> Float[Array, "3"]:
    return safe_norm(_jacobian(chart, q), axis=0)


def _basis(chart: AbstractChart, q: Float[Array, "3"]) -> Float[Array, "3 3"]:
    return orthonormal_frame(_jacobian(chart, q))


def _right_handed(chart: AbstractChart, q: Float[Array, "3"]) -> Bool[Array, ""]:
    return is_right_handed(_basis(chart, q))


def _angular_velocity(chart: AbstractChart, q: Float[Array, "3"], qd: Float[Array, "3"]) -> Float[Array, "3"]:
    frame, rate = jax.jvp(partial(_basis, chart), (q,), (qd,))
    # In a right-handed frame E^T dE/dt holds w as [[., -w3, w2], [w3, ., -w1], [-w2, w1, .]].
    (_, e2, e3), (rate1, rate2, _) = frame.T, rate.T
    turn = jnp.stack([jnp.sum(e3 * rate2), -jnp.sum(e3 * rate1), jnp.sum(e2 * rate1)])
    return jnp.where(is_right_handed(frame), turn, -turn)


def _spatial_velocity(chart: AbstractChart, q: Float[Array, "3"], qd: Float[Array, "3"]) -> Float[Array, "3"]:
    return jax.jvp(chart.position, (q,), (qd,))[1]


def _velocity(chart: AbstractChart, q: Float[Array, "3"], qd: Float[Array, "3"]) -> Float[Array, "3"]:
    return resolve(_spatial_velocity(chart, q, qd), _basis(chart, q))


def _acceleration(
    chart: AbstractChart, q: Float[Array, "3"], qd: Float[Array, "3"], qdd: Float[Array, "3"]
) -> Float[Array, "3"]:
    _, spatial = jax.jvp(partial(_spatial_velocity, chart), (q, qd), (qd, qdd))
    return resolve(spatial, _basis(chart, q))
