"""Whether a law can give back more energy than was put into it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.parameters import modules_of
from .._core.state_dependent import is_state_dependent, nominal
from ._armstrong import Armstrong
from ._coulomb import Coulomb
from ._dahl import Dahl
from ._elasto_plastic import ElastoPlastic
from ._law import AbstractDynamicLaw, AbstractForceLaw, AbstractKarnoppLaw, AbstractLaw, AbstractSetValuedLaw
from ._lugre import LuGre
from ._maxwell_slip import MaxwellSlip
from ._stribeck import Stribeck
from ._viscous import Viscous
from .modifiers._asymmetric import _AsymmetricDynamic, _AsymmetricForce, _AsymmetricSetValued
from .wrappers._regularized import Regularized
from .wrappers._sign import Sign

# Laws that are evaluated at any speed without harm, so that the limit of high speeds may be taken.
_TAME = (
    *(Viscous, Coulomb, Stribeck, Regularized, Sign),
    *(_AsymmetricForce, _AsymmetricSetValued),
)
_SLOWEST = 1e-9  # [m/s], where the search of speeds begins
_STATES = 2000  # states that a law without a closed form is brought to

Array = np.ndarray


@dataclass(frozen=True)
class Passivity:
    """Answer of `check_passivity`; true where the law is passive, and printed as a sentence.

    - `ok`: whether the law is passive.
    - `margin`: viscous coefficient [N s/m] that could be taken away before the law stops being passive; below zero,
      what has to be added, and -inf where that does not help.
    - `speed`: slip speed [m/s] up to which no more comes back than went in; infinite where that holds at all speeds.
    - `condition`: what decides, in words, with the law's numbers in it.
    """

    ok: bool
    margin: float
    speed: float
    condition: str

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        """All of it in a sentence or two."""
        if self.ok:
            return f"Passive, with a margin of {self.margin:g} N s/m. {self.condition}"
        return f"Not passive from {self.speed:g} m/s on; margin {self.margin:g} N s/m. {self.condition}"


def check_passivity(law: AbstractLaw, *, v_max: float = 1e3) -> Passivity:
    """Whether a law is passive from slip velocity to force: it never returns more energy than it was given.

    The energy in its state, `law.stored_energy`, is the storage, so the question is whether the dissipation
    `D = v F(v, z) - d/dt stored(z)` is >= 0 at all velocities and all states that can be reached. The margin is
    the least `D/v^2`: a term `sigma v` more in the force adds `sigma v^2` to D.

    - LuGre, v > 0, bristle force `g u` with `u <= Fs/g`: `D/v = g u^2 + v (sigma2 + sigma1 (1 - u))`. Negative only
      for u > 1: the bristle was loaded slowly, and the speed has risen since. At high speed the last term decides,
      with the largest `u = Fs/Fc`: passive if and only if `sigma2 >= sigma1 (Fs - Fc)/Fc`. No other storage helps:
      where this fails, ever faster jerks after a slow loading draw as much energy as one likes, of order
      `sigma1 v^2` for the time `Fc/(sigma0 v)`. With `vd` that damping is `sigma1 exp(-(v/vd)^2)`, and sigma2 must be
      above the largest `sigma1 exp(-(v/vd)^2) (u - 1) - g u^2/v`, searched over v; u = v sigma1(v)/(2 g) is the worst,
      within 1 and Fs/g.
    - ElastoPlastic: `D/v = g alpha u^2 + v (sigma2 + sigma1 (1 - alpha u))`, with alpha = 1 from u = 1 on: the same.
    - Dahl: `D = |v| Fc u^2`. MaxwellSlip and Armstrong: an element lags only towards the side that it is loaded on,
      so `k z (v - z') >= 0`. Always passive.
    - Functions of velocity and set-valued laws: `F(v) v >= 0`, searched over both directions. A `DeadZone` is not
      passive: in its band the force is the load, whatever direction the band is crossed in.
    - With other parameters for negative slip: each direction by itself, since a deflection towards one side was
      reached in that direction.
    - A law of your own with a state: at many states that its `advance` reaches. That can refute, but not prove.

    **Arguments:**

    - `law`: any law that has values by itself. What `scaled_by` made depend on the mechanism is judged at one state,
      `check_passivity(law.bind_state(t, q, qd, params))`; that says nothing about the energy that a change of the load
      brings into a bristle whose stiffness follows it.
    - `v_max`: largest speed searched [m/s], > 0, for functions and laws of your own; others are judged at all speeds.

    **Returns:**

    A `Passivity`.

    **Raises:**

    - `ValueError` for a law by `scaled_by`, what is no law, or a force that is not finite.

    ??? cite "Reference"

        ```bibtex
        @article{astrom2008revisiting,
            author={Astrom, Karl Johan and Canudas de Wit, Carlos},
            title={Revisiting the {LuGre} friction model},
            journal={IEEE Control Systems Magazine},
            volume={28}, number={6}, pages={101--114}, year={2008},
        }
        ```
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(f"passive needs a law, but {law!r} was given; of a function of velocity make a Curve(fn).")
    need_values(law, "passive")
    return _judge(law, v_max)


def need_values(law: AbstractLaw, wanted: str) -> None:
    """Refuse a law that has values only at a state of the mechanism.

    **Raises:**

    - `ValueError` that says how to get the law at a state.
    """
    if is_state_dependent(law):
        raise ValueError(
            f"{wanted} needs the numbers of the law, but parameters of this {type(law).__name__} depend on the state of"
            " the mechanism (scaled_by): ask law.bind_state(t, q, qd, params) for the law at a state, and give that."
        )


@singledispatch
def _judge(law: Any, v_max: float) -> Passivity:
    del v_max
    raise ValueError(f"passive knows nothing of laws such as {type(law).__name__}.")


@_judge.register
def _(law: LuGre, v_max: float) -> Passivity:
    del v_max
    return _bristle(law, nominal(law.vd))


@_judge.register
def _(law: ElastoPlastic, v_max: float) -> Passivity:
    del v_max
    return _bristle(law, None)


def _bristle(law: LuGre | ElastoPlastic, vd: Any) -> Passivity:
    """A bristle with damping, which fades over `vd` if that is given."""
    s1, s2, fc, fs, vs = (float(x) for x in (law.sigma1, law.sigma2, law.Fc, law.Fs, law.vs))

    def least(v: Array) -> Array:
        """Least `D/v^2` [N s/m] over the deflections from the limit on, at the speeds v > 0."""
        g = fc + (fs - fc) * np.exp(-np.square(v / vs))
        damping = s1 if vd is None else s1 * np.exp(-np.square(v / float(vd)))
        u = np.clip(v * damping / (2.0 * g), 1.0, fs / g)
        return s2 + g * u * u / v - damping * (u - 1.0)

    name = type(law).__name__
    scales = [vs] if vd is None else [vs, float(vd)]
    scales += [fc / s1] if s1 > 0 else []
    if vd is None:
        margin, words = s2 - s1 * (fs - fc) / fc, "sigma1 (Fs - Fc)/Fc"
    else:
        grid = _logarithmic(1e-3 * min(scales), 1e3 * max(scales))
        margin, words = min(_least_on(least, grid)[0], s2), "the largest sigma1 exp(-(v/vd)^2) (u - 1) - g(v) u^2/v"
    if abs(margin) <= 8.0 * float(jnp.finfo(law.Fc.dtype).eps) * s2:
        margin = 0.0  # equality, but for rounding of the product
    condition = f"{name} is passive if and only if sigma2 >= {words}: {s2:g} against {s2 - margin:g} N s/m."
    speed = math.inf
    if margin < 0:
        speed = _first_negative(least, _logarithmic(1e-3 * min(scales), 2.0 * max(*scales, fs * fs / fc / -margin)))
    return Passivity(margin >= 0, margin, speed, condition)


@_judge.register
def _(law: Dahl, v_max: float) -> Passivity:
    del law, v_max
    return Passivity(True, 0.0, math.inf, "Dahl is always passive: it dissipates |v| (sigma0 z)^2/Fc.")


@_judge.register
def _(law: MaxwellSlip, v_max: float) -> Passivity:
    del v_max
    words = "MaxwellSlip is always passive: an element lags only towards the side that it is loaded on."
    return Passivity(True, float(law.sigma2), math.inf, words)


@_judge.register
def _(law: Armstrong, v_max: float) -> Passivity:
    del v_max
    words = "Armstrong is always passive: the contact gives way only towards the side that it is loaded on."
    return Passivity(True, float(law.Fv), math.inf, words)


@_judge.register
def _(law: AbstractKarnoppLaw, v_max: float) -> Passivity:
    del v_max
    worst = max(float(law.static_limit(jnp.asarray(side))) for side in (1.0, -1.0))
    words = (
        f"In the band about rest the force of {type(law).__name__} is the load, up to {worst:g} N in either direction:"
        " a load that brakes is cancelled, by a force that pushes along the motion. The law inside, run by events, does"
        " not do that."
    )
    return Passivity(worst == 0, -math.inf if worst > 0 else 0.0, 0.0 if worst > 0 else math.inf, words)


@_judge.register
def _(law: AbstractForceLaw, v_max: float) -> Passivity:
    return _function(law, lambda law, v: law.force(v), v_max)


@_judge.register
def _(law: AbstractSetValuedLaw, v_max: float) -> Passivity:
    return _function(law, lambda law, v: jnp.sign(v) * law.sliding_force(v) + law.viscous_force(v), v_max)


def _function(law: AbstractLaw, force: Callable[..., Any], v_max: float) -> Passivity:
    """A force that is a function of the velocity."""
    dtype = _dtype(law)
    forces = jax.jit(jax.vmap(force, in_axes=(None, 0)))

    def least(v: Array) -> Array:
        both = jnp.concatenate([jnp.asarray(v, dtype), -jnp.asarray(v, dtype)])
        ratios = np.asarray(forces(law, both)).astype(float) / np.asarray(both).astype(float)
        if not np.isfinite(ratios).all():
            where = float(both[int(np.argmin(np.isfinite(ratios)))])
            raise ValueError(f"passive: the force is not finite at v = {where:g} m/s; give a v_max below that.")
        return np.minimum(*np.split(ratios, 2))

    grid = _logarithmic(_SLOWEST, v_max)
    margin, worst = _least_on(least, grid)
    range_ = f"for |v| <= {v_max:g} m/s"
    if all(isinstance(module, _TAME) for _, module in modules_of(law)):
        far = float(least(np.array([float(jnp.finfo(dtype).max) ** 0.9]))[0])
        margin = min(margin, 0.0 if abs(far) < 1e-30 else far)
        range_ = "at every speed"
    words = f"F(v) v >= 0 is needed; F/v is at least {margin:g} N s/m {range_}"
    if margin >= 0:
        return Passivity(True, margin, math.inf, f"{words}.")
    return Passivity(False, margin, _first_negative(least, grid), f"{words}, and least at {worst:g} m/s.")


@_judge.register
def _(law: _AsymmetricDynamic, v_max: float) -> Passivity:
    if _judge.dispatch(type(law.forward)) is _judge.dispatch(AbstractDynamicLaw):
        return _sampled(law, v_max)
    sides = {"positive": _judge(law.forward, v_max), "negative": _judge(law.implied["backward"], v_max)}
    worse = min(sides, key=lambda side: sides[side].margin)
    one = sides[worse]
    speed = min(side.speed for side in sides.values())
    return Passivity(one.ok, one.margin, speed, f"For {worse} slip, the worse direction: {one.condition}")


@_judge.register
def _sampled(law: AbstractDynamicLaw, v_max: float) -> Passivity:
    """A law that nothing is known of: at the states that random slip brings it to."""
    dtype = _dtype(law)
    # A fixed seed: the same law gives the same answer.
    random = np.random.default_rng(0)
    slips = random.choice([-1.0, 1.0], _STATES) * 10.0 ** random.uniform(-6.0, math.log10(v_max), _STATES)
    times = 10.0 ** random.uniform(-9.0, 1.0, _STATES) / np.abs(slips)
    speeds = _logarithmic(_SLOWEST, v_max, per_decade=20)
    both = jnp.asarray(np.concatenate([speeds, -speeds]), dtype)
    lost = np.asarray(_losses(law, jnp.asarray(slips, dtype), jnp.asarray(times, dtype), both)).astype(float)
    index = lost / np.square(np.asarray(both).astype(float))
    if not np.isfinite(index).all():
        raise ValueError(f"passive: the power of {type(law).__name__} is not finite at speeds up to {v_max:g} m/s.")
    by_speed = np.min(np.minimum(*np.split(index, 2, axis=1)), axis=0)
    margin = float(by_speed.min())
    words = f"v F - d/dt stored over v^2 is at least {margin:g} N s/m at {_STATES} states for |v| <= {v_max:g} m/s"
    if margin >= 0:
        return Passivity(True, margin, math.inf, f"{words}: not refuted by sampling, which is no proof.")
    return Passivity(False, margin, float(speeds[int(np.argmax(by_speed < 0))]), f"{words}.")


@eqx.filter_jit
def _losses(law: AbstractDynamicLaw, slips: jax.Array, times: jax.Array, speeds: jax.Array) -> jax.Array:
    """Dissipation [W] at each state along the slip and each speed, shape `[state, speed]`; 0 where it is rounding."""

    def step(z: Any, x: tuple[jax.Array, jax.Array]) -> tuple[Any, Any]:
        z = law.step_exact(x[0], z, x[1])
        return z, z

    states = jax.lax.scan(step, law.initial_state(jnp.zeros((), slips.dtype)), (slips, times))[1]

    def lost(z: Any, v: jax.Array) -> jax.Array:
        given = v * law.force(v, z)
        parts = jax.tree.map(lambda slope, rate: jnp.vdot(slope, rate), jax.grad(law.stored_energy)(z), law.zdot(v, z))
        kept = jnp.stack(jax.tree.leaves(parts))
        rounding = 64.0 * jnp.finfo(v.dtype).eps * (jnp.abs(given) + jnp.sum(jnp.abs(kept)))
        net = given - jnp.sum(kept)
        return jnp.where(jnp.abs(net) <= rounding, 0.0, net)

    return jax.vmap(jax.vmap(lost, in_axes=(None, 0)), in_axes=(0, None))(states, speeds)


def _dtype(law: AbstractLaw) -> Any:
    """Floating type of the law's numbers."""
    return jnp.result_type(float, *[x.dtype for x in jax.tree.leaves(law) if eqx.is_inexact_array(x)][:1])


def _logarithmic(low: float, high: float, per_decade: int = 200) -> Array:
    """Speeds [m/s] from `low` to `high`, evenly in the logarithm."""
    if not 0 < high < math.inf or high <= low:
        raise ValueError(f"passive: v_max must be finite and above {low:g} [m/s], but {high} was given.")
    return np.geomspace(low, high, 2 + math.ceil(per_decade * math.log10(high / low)))


def _least_on(fn: Callable[[Array], Array], grid: Array) -> tuple[float, float]:
    """Least value of `fn` on `grid`, refined about the least, and where it is."""
    values = fn(grid)
    least, where = float(values.min()), float(grid[int(np.argmin(values))])
    for _ in range(4):
        i = int(np.argmin(values))
        grid = np.geomspace(grid[max(i - 1, 0)], grid[min(i + 1, grid.size - 1)], grid.size)
        values = fn(grid)
        if float(values.min()) < least:
            least, where = float(values.min()), float(grid[int(np.argmin(values))])
    return least, where


def _first_negative(fn: Callable[[Array], Array], grid: Array) -> float:
    """Smallest speed on `grid` above which `fn` falls below zero, refined between its points."""
    for _ in range(4):
        i = int(np.argmax(fn(grid) < 0))
        if i == 0:
            return float(grid[0])
        grid = np.geomspace(grid[i - 1], grid[i], grid.size)
    return float(grid[0])
