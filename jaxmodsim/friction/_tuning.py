"""Numbers of a law that follow from what it should do."""

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.shapes import Scalar
from .._core.state_dependent import need_values
from ._law import AbstractSetValuedLaw
from ._max_stable_step import max_stable_step
from .wrappers._regularized import Regularized

# Velocities below the creep speed at which the force must stay below the load, and halvings of the width's bracket.
_SPEEDS, _HALVINGS = 2000, 200


def damping_sigma1(m: float, sigma0: float, ratio: float = 1.0, sigma2: float = 0.0) -> float:
    """Bristle damping [N s/m] with which a mass in stick vibrates with a given damping ratio.

    In stick `z' = v`, so `m v' = -sigma0 z - (sigma1 + sigma2) v`, for LuGre and ElastoPlastic alike, and
    `sigma1 = 2 ratio sqrt(m sigma0) - sigma2`. Where Fs > Fc, a sigma1 above `sigma2 Fc/(Fs - Fc)` costs passivity
    (`check_passivity`), and stiff bristles soon get there; LuGre with a `vd` of about vs keeps the damping in stick.

    **Arguments:**

    - `m`: mass [kg] or inertia [kg m^2] that the law holds, > 0.
    - `sigma0`: bristle stiffness [N/m], > 0.
    - `ratio`: damping ratio, > 0: 1 is critical.
    - `sigma2`: viscous coefficient of the law [N s/m], >= 0, which damps too.

    **Raises:**

    - `ValueError` if a number is out of range, or sigma2 alone damps more than that.
    """
    for name, value in (("m", m), ("sigma0", sigma0), ("ratio", ratio)):
        if not 0 < value < math.inf:
            raise ValueError(f"damping_sigma1: {name} must be finite and > 0, but {value} was given.")
    if not 0 <= sigma2 < math.inf:
        raise ValueError(f"damping_sigma1: sigma2 must be finite and >= 0 [N s/m], but {sigma2} was given.")
    critical = 2.0 * math.sqrt(m * sigma0)
    sigma1 = ratio * critical - sigma2
    if sigma1 < 0:
        raise ValueError(
            f"damping_sigma1: sigma2 = {sigma2:g} N s/m alone gives the damping ratio {sigma2 / critical:g}, above"
            f" {ratio:g}: a sigma1 of {sigma1:g} N s/m would be needed. Use 0, or a smaller sigma2."
        )
    return float(sigma1)


@dataclass(frozen=True)
class Width:
    """A width of `Regularized` and what it costs. `print` shows it as a sentence.

    - `width`: the width [m/s].
    - `creep`: velocity [m/s] at which the mass creeps under the load, below zero under a load below zero.
    - `load`: the load [N] it is for.
    - `rate`: fastest decay [1/s] of the mass's velocity, at rest: `(static limit/width + slope of the viscous part)/m`.
    - `step`: largest stable step [s] of Euler's method at that rate.
    - `law`: the law with that width.
    """

    width: float
    creep: float
    load: float
    rate: float
    step: float
    law: Regularized = field(repr=False)

    def __str__(self) -> str:
        """What the width gives and costs, as a sentence."""
        return (
            f"A width of {self.width:.4g} m/s: under {self.load:g} N it creeps at {self.creep:.4g} m/s, and velocities"
            f" decay at up to {self.rate:.4g} 1/s, so explicit Euler steps must stay below {self.step:.4g} s."
        )


def regularized_width(law: AbstractSetValuedLaw, creep: float, load: float, m: float) -> Width:
    """Largest width of `Regularized` with which a mass under a load creeps no faster than allowed.

    A regularised law has no stick: a load below the limit meets `F(v) = load` at some v, where the mass creeps. The
    width is solved from `F(creep) = load` for the law's own F, with its stiction hump and its fall; if the force
    would reach the load earlier at that width, from a width that makes it creep slower still.

    **Arguments:**

    - `law`: `Coulomb`, `Stribeck` or another set-valued law.
    - `creep`: allowed creep speed [m/s], > 0.
    - `load`: load it must carry [N], not zero; its sign is the direction it pulls to.
    - `m`: mass [kg], > 0, for the stiffness.

    **Returns:**

    A `Width`.

    **Raises:**

    - `ValueError` if a number is out of range, the law has no values or is not set-valued, or no width carries the
      load: the smooth hump of a law with stiction stays below its limit.
    """
    if not isinstance(law, AbstractSetValuedLaw):
        raise ValueError(f"regularized_width needs a set-valued law such as Coulomb, but {law!r} was given.")
    need_values(law, "regularized_width")
    for name, value in (("creep", creep), ("m", m)):
        if not 0 < value < math.inf:
            raise ValueError(f"regularized_width: {name} must be finite and > 0, but {value} was given.")
    side = math.copysign(1.0, load)
    limit = float(law.static_limit(jnp.asarray(side)))
    if not 0 < abs(load) < limit:
        raise ValueError(
            f"regularized_width: the load must be above 0 and below the limit of stick, {limit:g} N, but {load} N was"
            " given. Above the limit it slides whatever the width."
        )
    speeds = jnp.asarray(np.append(creep * np.geomspace(1e-9, 1.0, _SPEEDS)[:-1], creep))

    @jax.jit
    def forces(width: Scalar, speeds: Float[Array, " n"]) -> Float[Array, " n"]:
        return side * jax.vmap(Regularized(law, width).force)(side * speeds)

    def peak(width: float) -> float:
        return float(jnp.max(forces(jnp.asarray(width), speeds)))

    narrow, wide = 1e-6 * creep, 1e6 * creep
    most, least = peak(narrow), peak(wide)
    if least >= abs(load) or most < abs(load):
        raise ValueError(_no_width(law, load, creep, limit, most, least))
    for _ in range(_HALVINGS):
        middle = math.sqrt(narrow * wide)
        if not narrow < middle < wide:
            break
        narrow, wide = (middle, wide) if peak(middle) >= abs(load) else (narrow, middle)
    reached = np.asarray(forces(jnp.asarray(narrow), speeds)) >= abs(load)
    first = int(np.argmax(reached))
    near = jnp.linspace(speeds[max(first - 1, 0)], speeds[first], _SPEEDS + 1)[1:]
    crossed = np.asarray(forces(jnp.asarray(narrow), near)) >= abs(load)
    crept = creep if first == _SPEEDS - 1 else float(near[int(np.argmax(crossed))])
    smooth = Regularized(law, narrow)
    # A law with other parameters for either direction has a kink at zero: the slope is that of the load's side.
    step = max_stable_step(smooth, m, v=side * narrow * 1e-9)
    return Width(narrow, side * crept, load, 2.0 / step, step, smooth)


def _no_width(law: AbstractSetValuedLaw, load: float, creep: float, limit: float, most: float, least: float) -> str:
    name = type(law).__name__
    if least >= abs(load):
        return f"regularized_width: {name} carries {load:g} N at {creep:g} m/s by its viscous part: any width will do."
    return (
        f"regularized_width: no width of {name} carries {load:g} N below {creep:g} m/s. The smooth force reaches"
        f" {most:g} N at most, below the limit of {limit:g} N; the law run by events holds the load at rest."
    )
