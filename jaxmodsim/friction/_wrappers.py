"""Wrappers, which run a set-valued law in another way than by events."""

from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Bool

from .._core.arrays import Scalar
from .._core.parameters import Number, parameter
from .._core.safe import bounded_ratio
from ._law import (
    AbstractForceLaw,
    AbstractKarnoppLaw,
    AbstractLaw,
    AbstractSetValuedLaw,
    LawCase,
    register_law,
    stribeck_case,
)
from ._static import Stribeck


class AbstractWrapper(AbstractLaw):
    """A set-valued law that runs without events."""

    law: AbstractVar[AbstractSetValuedLaw]
    mujoco_lacks: ClassVar[str] = ": it runs dry friction as a constraint. Export the wrapped law"

    def formulas(self) -> tuple[str, ...]:
        """Equations of the wrapped law."""
        return self.law.formulas()

    def known_limitations(self) -> dict[str, str]:
        """Limitations of the wrapped law and of the wrapper."""
        return self.law.known_limitations() | dict(self.limitations)

    def modelica(self) -> str:
        """Modelica runs set-valued laws by events."""
        return f"{type(self).__name__}: they run the wrapped law exactly, by events. Export that"

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        """A wrapped Stribeck law."""
        case = stribeck_case(cls.__name__, cls.standard(law=Stribeck.standard()))
        return (case._replace(dt=cls.example_step),)


def need_set_valued(law: object, owner: str) -> AbstractSetValuedLaw:
    """Refuse a law that is not set-valued as a part of the law `owner`.

    **Raises:**

    - `ValueError` with `owner` and the kind of law.
    """
    if not isinstance(law, AbstractSetValuedLaw):
        kind = law if isinstance(law, str) else type(law).__name__
        raise ValueError(
            f"{owner} needs a set-valued law such as Coulomb or Stribeck, but {kind!r} was given. A law that is a"
            " function of velocity or has a state goes into Friction directly."
        )
    return law


@register_law
class Regularized(AbstractWrapper, AbstractForceLaw):
    """A set-valued law that is smooth over a width: `F = sliding_force(v) tanh(v/width) + viscous_force(v)`.

    Under a load below the limit the mass creeps at about `width * load/static_limit` instead of resting. The equations
    are stiff, with the rate `sliding_force(0)/(m width)`. If the limit of stick exceeds the slip force at zero velocity
    (`Coulomb` with `Fs`), the force has a smooth hump about `2 width` wide.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.
    - `width`: velocity [m/s] at which the force reaches 76 % of `sliding_force`, > 0; at least `atol` in adaptive runs.

    **Raises:**

    - `ValueError` if `law` is not set-valued or `width` is out of range.

    **Example:**

    ```python
    law = jms.Regularized(jms.Coulomb(Fc=5.0), width=1e-3)
    print(jax.vmap(law.force)(jnp.array([0.0, 1e-3, 1e-2])).round(3), "N")
    ```

    ```text
    [0.    3.808 5.   ] N
    ```
    """

    law: AbstractSetValuedLaw = eqx.field(converter=partial(need_set_valued, owner="Regularized"))
    width: Number = parameter("width", "m/s", lower=0.0, strict=True, execution=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "smooth over `width`; creeps below the limit"
    equations: ClassVar[tuple[str, ...]] = ("sliding_force(v) tanh(v/width) + viscous_force(v)",)
    execution: ClassVar[str] = "default solver `Rodas5P`"
    valid_at_any_speed: ClassVar[bool] = True

    def formulas(self) -> tuple[str, ...]:
        """Equations of the wrapped law, with a smooth sign."""
        first, *rest = self.law.formulas()
        return first.replace("sign(v)", "tanh(v/width)"), *rest, f"width = {float(self.width):.4g} m/s"

    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s]."""
        v = jnp.asarray(v)
        level, spread = self.law.sliding_force(v), 0.5 * bounded_ratio(v, self.width)
        direction = jnp.where(v < 0, -1.0, 1.0).astype(v.dtype)
        # The limit of v = 0 from the side of v: an asymmetric law has other parameters on either side.
        rest = direction * float(jnp.finfo(v.dtype).tiny)
        excess = self.law.static_limit(direction) - self.law.sliding_force(rest)
        return (level + excess * jnp.exp(-spread * spread)) * jnp.tanh(v / self.width) + self.law.viscous_force(v)


@register_law
class DeadZone(AbstractWrapper, AbstractKarnoppLaw):
    """A set-valued law that runs by Karnopp's rule: velocities up to `width` count as rest.

    In the band friction equals the load, up to the limit of stick, so the velocity keeps its value, zero or not.
    Outside the band the slip force of the law acts. Use a fixed step: the vector field jumps at the edges of the band.
    A step can miss a band that is narrower than its change of velocity. JAX does not see the jumps, so that derivatives
    of a run would be wrong, by up to several times their size: they raise an error.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.
    - `width`: half-width of the band [m/s], > 0.

    **Raises:**

    - `ValueError` if `law` is not set-valued or `width` is out of range, and for derivatives of a run.

    **Example:**

    ```python
    law = jms.DeadZone(jms.Coulomb(Fc=1.5), width=1e-3)
    run = jms.simulate(jms.problems.ramped_box.scene(law), [0.0], [0.0], 3.0, dt=1e-3)
    print(f"{run.qd[-1, 0]:.2f} m/s")
    ```

    ```text
    0.56 m/s
    ```

    ??? cite "Reference"

        ```bibtex
        @article{karnopp1985computer,
            author={Karnopp, Dean},
            title={Computer simulation of stick-slip friction in mechanical dynamic systems},
            journal={Journal of Dynamic Systems, Measurement, and Control},
            volume={107}, number={1}, pages={100--103}, year={1985},
        }
        ```
    """

    law: AbstractSetValuedLaw = eqx.field(converter=partial(need_set_valued, owner="DeadZone"))
    width: Number = parameter("width", "m/s", lower=0.0, strict=True, execution=True)
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "Karnopp: velocities up to `width` count as rest"
    equations: ClassVar[tuple[str, ...]] = ("sliding_force(v) sign(v) + viscous_force(v) outside the band",)
    execution: ClassVar[str] = "fixed step `dt=`"
    # A step of 0.1 ms changes the velocity of 1 kg under 1 N by half of the band from -width to +width.
    example: ClassVar[Mapping[str, float]] = {"width": 1e-4}
    example_step: ClassVar[float | None] = 1e-4

    def holds(self, v: Scalar) -> Bool[Array, ""]:
        """Whether `v` [m/s] is in the band, edges included."""
        return jnp.abs(v) <= self.width

    def static_limit(self, direction: Scalar) -> Scalar:
        """Largest holding force [N]."""
        return self.law.static_limit(direction)

    def force(self, v: Scalar) -> Scalar:
        """Slip force [N] at velocity `v` [m/s]."""
        return self.law.sliding_force(v) * jnp.sign(v) + self.law.viscous_force(v)


@register_law
class Sign(AbstractWrapper, AbstractForceLaw):
    """A set-valued law with a plain `sign(v)` and no stick, to demonstrate why that fails.

    A fixed step chatters about zero velocity; an adaptive step becomes arbitrarily small there. Derivatives of a run
    would lack the jumps: they raise an error.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.

    **Raises:**

    - `ValueError` if `law` is not set-valued, and for derivatives of a run.

    **Example:**

    ```python
    law = jms.Sign(jms.Coulomb(Fc=5.0))
    print(jax.vmap(law.force)(jnp.array([-0.1, 0.0, 0.1])), "N")
    ```

    ```text
    [-5.  0.  5.] N
    ```
    """

    law: AbstractSetValuedLaw = eqx.field(converter=partial(need_set_valued, owner="Sign"))
    stiff: ClassVar[bool] = False
    description: ClassVar[str] = "plain `sign(v)`, to demonstrate why it fails"
    equations: ClassVar[tuple[str, ...]] = ("sliding_force(v) sign(v) + viscous_force(v)",)
    execution: ClassVar[str] = "fixed step `dt=`"
    valid_at_any_speed: ClassVar[bool] = True
    jumps: ClassVar[bool] = True
    example_step: ClassVar[float | None] = 1e-4

    def force(self, v: Scalar) -> Scalar:
        """Friction force [N] at velocity `v` [m/s], zero at `v = 0`."""
        return self.law.sliding_force(v) * jnp.sign(v) + self.law.viscous_force(v)
