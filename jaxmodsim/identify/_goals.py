"""What a good experiment is: functions of the information matrix, the larger the better."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def d_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Mean logarithm of the eigenvalues: a small volume of the confidence ellipsoid, whatever the units."""
    return jnp.linalg.slogdet(information)[1] / information.shape[0]


def a_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Minus the logarithm of the mean variance of the relative errors."""
    return -jnp.log(jnp.trace(jnp.linalg.inv(information)) / information.shape[0])


def e_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Logarithm of the smallest eigenvalue: the combination of numbers that is known worst is known best."""
    return jnp.log(jnp.maximum(jnp.linalg.eigvalsh(information)[0], jnp.finfo(information.dtype).tiny))
