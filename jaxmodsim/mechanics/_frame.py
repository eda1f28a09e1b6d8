"""An orthonormal frame along three tangents, with a derivative that keeps its digits where one of them is short."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core.safe import safe_norm
from .._core.shapes import Scalar

# Unit tangents whose volume is below this many roundings count as dependent: their own roundings would leave fewer
# than about two right digits of the frame. Lengths do not enter, so a tangent may be short, as it is close to a pole.
_DEPENDENT = 100.0


def orthonormal_frame(tangents: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Gram-Schmidt on three tangents, the columns of `tangents`; columns of the result are e_1, e_2, e_3.

    One tangent may be zero: the frame is then completed to a right-handed one.

    **Raises:**

    - `RuntimeError` at run time if more than one tangent is zero, or they are dependent to rounding.
    """
    # Cyclic neighbours, so that the completed frame is right-handed whichever direction is missing.
    completed = jnp.cross(jnp.roll(tangents, -1, axis=1), jnp.roll(tangents, -2, axis=1), axis=0)
    missing = jnp.all(tangents == 0, axis=0, keepdims=True)
    units = _scaled(jnp.where(missing, completed, tangents))
    units = eqx.error_if(
        units,
        # NaN passes: what is not finite stays visible as such.
        jnp.abs(_triple(units)) <= _DEPENDENT * jnp.finfo(units.dtype).eps,
        "At the coordinates given, more than one of the three tangents d position/dq_i is zero, or they are linearly"
        " dependent to rounding (as at r = 0 of spherical coordinates). A frame needs independent tangents, of which"
        " one at most is zero. Keep the point away from there, or take coordinates that are regular there.",
    )
    return _gram_schmidt(units)


def is_right_handed(frame: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """Whether `e_1 x e_2 = e_3`, not -e_3."""
    return _triple(frame) > 0


def resolve(vector: Float[Array, "3"], frame: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Components of a Cartesian vector in the frame; a sum, as matrix products may round coarsely on GPUs."""
    return jnp.sum(frame * vector[:, None], axis=0)


@jax.custom_jvp
def _gram_schmidt(tangents: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    t1, t2, _ = tangents.T
    e1 = _scaled(t1)
    # Cross products instead of t2 less its part along e1: normal to rounding also where the two are nearly parallel.
    e2 = _scaled(jnp.cross(jnp.cross(e1, t2), e1))
    e3 = jnp.where(_triple(tangents) < 0, -1.0, 1.0) * jnp.cross(e1, e2)
    return jnp.stack([e1, e2, e3], axis=1)


@_gram_schmidt.defjvp
def _(primals: Any, rates: Any) -> Any:
    """`dE = E W`, W skew, its lower triangle that of `E^T dT R^-1`, from `T = E R` with R upper triangular.

    Differentiating the operations instead would project the large change in length of a short tangent out of its
    change, and so leave roundings of the order of its inverse length.
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
    """Vectors along the first axis divided by their length; zero stays zero.

    Derivatives take the length for a constant. The frame does not depend on it, and its square may underflow.
    """
    length = jax.lax.stop_gradient(safe_norm(vectors, axis=0))[None]
    return vectors / jnp.where(length == 0, 1.0, length)


def _triple(columns: Float[Array, "3 3"]) -> Scalar:
    """Triple product (a x b) . c of three columns."""
    a, b, c = columns.T
    return jnp.sum(jnp.cross(a, b) * c)
