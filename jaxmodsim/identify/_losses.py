"""What a residual costs: its square, or less where it is large."""

import abc
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.parameters import Number, check_ranges, parameter

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar


class AbstractLoss(eqx.Module):
    """Loss of a residual in units of its noise level, as a function of its square: `rho(s)`, rho = s for small s."""

    robust: AbstractClassVar[bool]

    @abc.abstractmethod
    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""

    def cost(self, residual: Float[Array, " m"]) -> Float[Array, ""]:
        """Half the sum of the losses."""
        return 0.5 * jnp.sum(self.rho(residual**2))

    def weighted(
        self, residual: Float[Array, " m"], jacobian: Float[Array, "m n"]
    ) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
        """Residual and Jacobian whose least squares have the gradient of the cost and nearly its curvature.

        Triggs et al. 2000, Bundle adjustment, section 4.3, without the second derivative of rho, which is negative
        and may take the definiteness away.
        """
        if not self.robust:
            return residual, jacobian
        weight = jnp.sqrt(jax.vmap(jax.grad(self.rho))(residual**2))
        return weight * residual, weight[:, None] * jacobian


class Squares(AbstractLoss):
    """Least squares: the maximum likelihood of normal noise."""

    robust: ClassVar[bool] = False

    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""
        return s


class Huber(AbstractLoss):
    """Squares up to `limit` noise levels and the distance beyond: outliers pull with a bounded force.

    **Arguments:**

    - `limit`: in noise levels, > 0; 1.345 keeps 95 % of the efficiency of least squares on normal noise (Huber 1964).
    """

    limit: Number = parameter("limit", "1", lower=0.0, strict=True, default=1.345)
    robust: ClassVar[bool] = True

    def __check_init__(self) -> None:
        """Refuse a limit out of range."""
        check_ranges(self)

    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""
        inside = s <= self.limit**2
        return jnp.where(inside, s, 2 * self.limit * jnp.sqrt(jnp.where(inside, 1.0, s)) - self.limit**2)


class Cauchy(AbstractLoss):
    """`limit^2 log(1 + s/limit^2)`: far outliers have no pull at all.

    **Arguments:**

    - `limit`: in noise levels, > 0; 2.385 keeps 95 % of the efficiency of least squares on normal noise.
    """

    limit: Number = parameter("limit", "1", lower=0.0, strict=True, default=2.385)
    robust: ClassVar[bool] = True

    def __check_init__(self) -> None:
        """Refuse a limit out of range."""
        check_ranges(self)

    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""
        return self.limit**2 * jnp.log1p(s / self.limit**2)
