"""What happens where a contact is struck, beside Newton's law of impact, which is a number."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.parameters import Number, check_ranges, parameter
from .._core.safe import safe_power
from .._core.shapes import Scalar

# Newton steps to the speed after an impact; at a small speed each of the first ones halves the error.
_NEWTON = 60


class Poisson(eqx.Module):
    """Poisson's law of impact: in expansion a contact gives back at least the part `e` of its impulse of compression.

    In compression the impulses are those of an impact without restitution. In expansion each is at least `e` times
    that, and more where the gap would close otherwise. Contacts that are closed take part with their own `e`. Friction
    obeys Coulomb's law in either phase, by the slip at its end.

    Energy is never gained without friction, whatever the coefficients: twice the impulses of compression are admissible
    in expansion and would restore it all, and those that result minimise it. With friction the same follows for equal
    coefficients.

    **Arguments:**

    - `e`: coefficient, 0 to 1.

    ??? cite "Reference"

        ```bibtex
        @book{pfeiffer1996multibody,
            author={Pfeiffer, F. and Glocker, C.}, title={Multibody Dynamics with Unilateral Contacts},
            publisher={Wiley}, year={1996}, note={chapter 8},
        }
        ```
    """

    e: Number = parameter("e", "", lower=0.0, upper=1.0)

    def __check_init__(self) -> None:
        """Refuse a coefficient out of range."""
        check_ranges(self)


class HuntCrossley(eqx.Module):
    """A compliant contact: at the penetration d > 0 the force `k d^n (1 + 3/2 damping d')`, but never a pull.

    There is no impact and no mode: a body that strikes with the speed v leaves with `restitution(v)` times that, about
    `1 - damping v`, after a time that shrinks as `stiffness**(-1/(n + 1))`; so does the difference to a rigid contact
    with that coefficient. `k d^(n + 1)/(n + 1)` is stored.

    **Arguments:**

    - `stiffness`: k [N/m^n], > 0.
    - `exponent`: n, >= 1; 3/2 for spheres (Hertz).
    - `damping`: [s/m], >= 0.

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

    def __check_init__(self) -> None:
        """Refuse numbers out of range."""
        check_ranges(self)

    def force(self, depth: Scalar, rate: Scalar) -> Scalar:
        """Force [N] at the penetration `depth` [m], negative where the contact is open, and its rate [m/s]."""
        elastic = self.stiffness * safe_power(jnp.maximum(depth, 0.0), self.exponent)
        return elastic * jnp.maximum(1.0 + 1.5 * self.damping * rate, 0.0)

    def stored_energy(self, depth: Scalar) -> Scalar:
        """Energy [J] stored at the penetration `depth` [m]."""
        power = self.exponent + 1.0
        return self.stiffness * safe_power(jnp.maximum(depth, 0.0), power) / power

    def restitution(self, speed: Float[Array, ""] | float) -> Float[Array, ""]:
        """Coefficient of restitution of a single body that strikes at `speed` [m/s], > 0.

        With `y = 3/2 damping speed` it solves `(1 + e) y = log((1 + y)/(1 - e y))`, whatever mass, k and n.
        """
        y = 1.5 * self.damping * speed
        c = 1.0 + y - jnp.log1p(y)  # u - log(u) = c for u = 1 - e y, from below

        def step(_: object, u: Array) -> Array:
            return u + (u - jnp.log(u) - c) * u / jnp.where(u < 1.0, 1.0 - u, 1.0)

        u = jax.lax.stop_gradient(jax.lax.fori_loop(0, _NEWTON, step, jnp.exp(-c)))
        return jnp.where(y > 1e-6, (1.0 - step(0, u)) / jnp.where(y > 1e-6, y, 1.0), 1.0 - y / 1.5)
