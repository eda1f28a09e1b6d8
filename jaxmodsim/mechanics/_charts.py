"""Coordinates in space and their orthonormal frame, by differentiation of the position alone."""

import abc
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._core.arrays import Scalar
from .._core.functions import as_function
from .._core.parameters import as_real
from .._core.safe import safe_norm
from .._core.trace_checks import check_indices

_Triples: TypeAlias = ArrayLike | Sequence[Any]


class AbstractChart(eqx.Module):
    """Three coordinates q of a point in space, and the orthonormal frame that moves with it.

    A chart defines only the position of the point. Gram-Schmidt makes the tangents `d position/dq_i` orthonormal, in
    the order of the coordinates: e_1 along the first tangent, e_2 in the plane of the first two, e_3 normal to it. Each
    e_i is on the side of its own tangent. For orthogonal coordinates they are the unit tangents. The order of the
    coordinates determines whether the frame is right-handed.

    Lengths are in metres. Every method takes leading batch axes, works under `jax.jit`, `jax.vmap` and derivatives,
    and keeps the floating dtype; integers are converted.

    **Poles.** If exactly one tangent is zero, the cross product of the other two completes a right-handed frame. Values
    and derivatives stay finite there, and the derivative of `scale_factors` is zero. If more than one tangent is zero,
    or the tangents are linearly dependent to rounding, there is no frame: `basis`, `right_handed`, `angular_velocity`,
    `velocity` and `acceleration` raise; `position`, `jacobian` and `scale_factors` do not.

    **Raises:**

    - `ValueError` from every method if the shape of q is not `[..., 3]`, or the shape of qd or qdd is not that of q.
    - `RuntimeError` at run time, by `equinox.error_if`, if any point of a batch has no frame.
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

        If the frame is right-handed, this is the rotation matrix from the frame to the fixed axes: `basis @ a` are the
        Cartesian components of a vector with the components `a` in the frame.
        """
        return _batched(_basis, "(n)->(n,n)", self, q=q)

    def right_handed(self, q: _Triples) -> Bool[Array, "..."]:
        """Whether `e_1 x e_2 = e_3` (otherwise it is -e_3), shape `[...]`."""
        return _batched(_right_handed, "(n)->()", self, q=q)

    def angular_velocity(self, q: _Triples, qd: _Triples) -> Float[Array, "... 3"]:
        """Angular velocity w of the frame relative to the fixed axes, in components of the frame.

        `d e_i/dt = w x e_i`, positive by the right-hand rule, for left-handed frames as well.

        Close to a pole `Cylindrical`, `Spherical` and every chart whose last tangent is the short one keep all digits.
        If tangents of changing direction follow the short tangent, rounding grows as the inverse of its length, here
        and in derivatives of `basis`: put its coordinate last.

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

        `a = J qdd + (dJ/dt) qd` with the Jacobian J, including centripetal and Coriolis terms.

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

    On the axis, r = 0, the tangent along theta vanishes, and e_theta is `e_z x e_r`. For r < 0 the tangent and e_theta
    point backwards: the frame is left-handed.

    **Example:**

    ```python
    print(jms.Cylindrical().acceleration(q=[2.0, 0.0, 0.0], qd=[0.0, 3.0, 0.0], qdd=[0.0, 0.0, 0.0]), "m/s^2")
    ```

    ```text
    [-18.   0.   0.] m/s^2
    ```
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

    At the pole, phi = 0, the tangent along theta vanishes, and e_theta is `e_r x e_phi`, which depends on theta; the
    formulas above hold. (At phi = pi a floating-point sine is not zero, so no tangent vanishes.) At r = 0 there is no
    frame. For sin(phi) < 0 the tangent along theta and e_theta point backwards: the frame is left-handed. For r < 0
    both e_phi and e_theta change sign.

    **Example:**

    ```python
    print(jms.Spherical().velocity(q=[2.0, jnp.pi / 2, 0.0], qd=[0.0, 0.0, 3.0]).round(6), "m/s")
    ```

    ```text
    [0. 0. 6.] m/s
    ```
    """

    def position(self, q: _Triples) -> Float[Array, "... 3"]:
        """(r sin(phi) cos(theta), r sin(phi) sin(theta), r cos(phi)) [m], shape `[..., 3]`."""
        r, phi, theta = _components(q)
        radius = r * jnp.sin(phi)
        return jnp.stack([radius * jnp.cos(theta), radius * jnp.sin(theta), r * jnp.cos(phi)], axis=-1)


class Chart(AbstractChart):
    """User-defined coordinates, orthogonal or not, right- or left-handed.

    A tangent counts as vanishing only if it is exactly zero.

    **Arguments:**

    - `position`: `position(q)` returns the Cartesian coordinates [m] as an array of shape `[3]` for q of shape `[3]`;
      a pure JAX function. Numbers to differentiate or sweep belong in the leaves of an `eqx.Module`, passed as
      `position`.

    **Raises:**

    - `ValueError` if `position` is not a function or uses an index out of range, or (from every method) if it returns
      anything but three real numbers.

    **Example:**

    ```python
    parabolic = jms.Chart(lambda q: jnp.stack([q[0] * q[1], 0.5 * (q[0] ** 2 - q[1] ** 2), q[2]]))
    print(parabolic.scale_factors([3.0, 4.0, 0.0]))
    ```

    ```text
    [5. 5. 1.]
    ```
    """

    function: Callable[..., Any]

    def __init__(self, position: Any) -> None:
        self.function = as_function(position, name="Chart position")
        check_indices(self.function, jax.ShapeDtypeStruct((3,), jnp.result_type(float)), name="Chart position")

    def position(self, q: _Triples) -> Float[Array, "... 3"]:
        """The result of the function [m], shape `[..., 3]`."""

        def point(q: Array) -> Array:
            x = self.function(q)
            if getattr(x, "shape", None) != (3,) or not jnp.issubdtype(x.dtype, jnp.floating):
                result = f"{x.dtype}{list(x.shape)}" if hasattr(x, "shape") else f"a {type(x).__name__}"
                raise ValueError(
                    f"Chart: position(q) must return a floating array of shape [3], but for q of shape [3] it returned"
                    f" {result}. Return jnp.stack([x, y, z])."
                )
            return jnp.asarray(x)

        return jnp.vectorize(point, signature="(n)->(n)")(*_checked(q=q))


def _checked(**triples: _Triples) -> list[Array]:
    """Convert to arrays of one floating dtype and one shape `[..., 3]`; the first is q."""
    arrays = {
        # A list may hold traced numbers.
        name: as_real(jnp.asarray(value) if isinstance(value, list | tuple) else value, name=name)
        for name, value in triples.items()
    }
    shape = arrays["q"].shape
    if shape[-1:] != (3,):
        raise ValueError(
            f"q must have the shape [..., 3], one entry for each of the three coordinates, but has the shape"
            f" {list(shape)}. Use leading axes for the coordinates of many points."
        )
    for name, array in arrays.items():
        if array.shape != shape:
            raise ValueError(f"{name} must have the shape of q, {list(shape)}, but has the shape {list(array.shape)}.")
    dtype = jnp.result_type(*arrays.values())
    return [array.astype(dtype) for array in arrays.values()]


def _components(q: _Triples) -> list[Array]:
    (array,) = _checked(q=q)
    return [array[..., i] for i in range(3)]


def _batched(point: Callable[..., Array], signature: str, chart: AbstractChart, **triples: _Triples) -> Array:
    """Apply `point(chart, q, ...)`, a function of one point, along all leading axes."""
    return _compiled(point, signature, chart, *_checked(**triples))


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
    # In a right-handed frame E^T dE/dt is [[., -w3, w2], [w3, ., -w1], [-w2, w1, .]].
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


# Unit tangents with a volume below this many rounding units count as dependent: their rounding would leave fewer than
# about two correct digits of the frame. Lengths do not matter, so a tangent may be short, as close to a pole.
_DEPENDENT = 100.0


def orthonormal_frame(tangents: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Gram-Schmidt on three tangents, the columns of `tangents`; columns of the result are e_1, e_2, e_3.

    One tangent may be zero; the other two then determine a right-handed frame.

    **Raises:**

    - `RuntimeError` at run time if more than one tangent is zero, or they are dependent to rounding.
    """
    # Cyclic neighbours, so that the completed frame is right-handed for any missing direction.
    completed = jnp.cross(jnp.roll(tangents, -1, axis=1), jnp.roll(tangents, -2, axis=1), axis=0)
    missing = jnp.all(tangents == 0, axis=0, keepdims=True)
    units = _scaled(jnp.where(missing, completed, tangents))
    units = eqx.error_if(
        units,
        # NaN passes the check and remains visible in the result.
        jnp.abs(_triple(units)) <= _DEPENDENT * jnp.finfo(units.dtype).eps,
        "At these coordinates more than one of the three tangents d position/dq_i is zero, or they are linearly"
        " dependent to rounding (as at r = 0 of spherical coordinates). A frame needs independent tangents, at most one"
        " of which is zero. Avoid such points, or use coordinates that are regular there.",
    )
    return _gram_schmidt(units)


def is_right_handed(frame: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """Whether `e_1 x e_2 = e_3`, not -e_3."""
    return _triple(frame) > 0


def resolve(vector: Float[Array, "3"], frame: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Components of a Cartesian vector in the frame; a sum, because matrix products may round coarsely on GPUs."""
    return jnp.sum(frame * vector[:, None], axis=0)


@jax.custom_jvp
def _gram_schmidt(tangents: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    t1, t2, _ = tangents.T
    e1 = _scaled(t1)
    # Cross products keep e2 normal to e1 to rounding, even for nearly parallel tangents.
    e2 = _scaled(jnp.cross(jnp.cross(e1, t2), e1))
    e3 = jnp.where(_triple(tangents) < 0, -1.0, 1.0) * jnp.cross(e1, e2)
    return jnp.stack([e1, e2, e3], axis=1)


@_gram_schmidt.defjvp
def _(primals: Any, rates: Any) -> Any:
    """`dE = E W` with W skew; its lower triangle is that of `E^T dT R^-1`, from `T = E R` with R upper triangular.

    Differentiation of the operations would subtract the large change in length of a short tangent from its change, and
    leave rounding errors of the order of its inverse length.
    """
    ((tangents,), (rate,)) = primals, rates
    frame = _gram_schmidt(tangents)
    (t1, t2, _), (e1, e2, e3) = tangents.T, frame.T
    r11, r12, r22 = jnp.sum(e1 * t1), jnp.sum(e1 * t2), jnp.sum(e2 * t2)
    _, by21, by31 = resolve(rate[:, 0], frame) / r11
    by32 = (jnp.sum(e3 * rate[:, 1]) - r12 * by31) / r22
    change = [e2 * by21 + e3 * by31, e3 * by32 - e1 * by21, -(e1 * by31 + e2 * by32)]
    return frame, jnp.stack(change, axis=1)


def _scaled(vectors: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Vectors along the first axis, divided by their length; zero stays zero.

    The length is constant under differentiation: the frame does not depend on it, and its square may underflow.
    """
    length = jax.lax.stop_gradient(safe_norm(vectors, axis=0))[None]
    return vectors / jnp.where(length == 0, 1.0, length)


def _triple(columns: Float[Array, "3 3"]) -> Scalar:
    """Triple product (a x b) . c of three columns."""
    a, b, c = columns.T
    return jnp.sum(jnp.cross(a, b) * c)
