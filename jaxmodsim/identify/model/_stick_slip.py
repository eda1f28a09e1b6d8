"""Exact stick and slip by steps of fixed length: each change of mode between two samples is located and passed."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int

from ...scene import Scene, State, from_dynamics, start, switch, vector_field
from ...solvers import RosenbrockTableau, rosenbrock_step

# Slip velocity [m/s] that counts as none, and the distance from a change of mode, in steps, at which it is reached.
_REST, _LANDED = 1e-12, 1e-9
# Trials of one step, and those after which the interval that holds a change of mode is halved in turn.
_MOST, _NEWTON = 256, 8

_constant = jax.lax.stop_gradient


class _PartialStep(NamedTuple):
    """A step on its way: what lies behind `t`, what is `left` of it [s], and the trial that goes on from there.

    - `lower`, `upper`, `trial`: lengths [s]; the next change of mode is between the first two if `upper < left`.
    - `trials`: their number in this step so far.
    """

    t: Float[Array, ""]
    left: Float[Array, ""]
    y: State
    mode: Float[Array, " modes"]
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    trial: Float[Array, ""]
    trials: Int[Array, ""]


# A step evaluates them several times; as functions of their own they are traced and linearised once.
@jax.jit
def _guards(t: Array, y: State, scene: Scene, mode: Array) -> Float[Array, " modes"]:
    """One for each element, positive while its mode holds."""
    rest = jnp.asarray(_REST, y.q.dtype)
    return from_dynamics(lambda d: d.guards(rest, (rest, rest)), t, y, scene, mode)[0]


_field = jax.jit(vector_field)
_switch = jax.jit(switch)


def first_modes(t: Array, y: State, scene: Scene) -> tuple[State, Float[Array, " modes"]]:
    """State and modes at the beginning of a run."""
    mode = jnp.zeros(len(scene.mode_names), y.q.dtype)
    return start(t, y, scene, mode, jnp.asarray(_REST, y.q.dtype))


def settle(t: Array, y: State, scene: Scene, mode: Array) -> tuple[State, Float[Array, " modes"]]:
    """State and modes where inputs may have jumped."""
    return _switch(t, y, scene, mode, _guards(t, y, scene, mode) < 0, jnp.asarray(_REST, y.q.dtype))


def pass_modes(
    tableau: RosenbrockTableau,
    scene_at: Callable[[Array], Scene],
    t: Float[Array, ""],
    dt: Float[Array, ""],
    y: State,
    mode: Float[Array, " modes"],
) -> tuple[State, Float[Array, " modes"]]:
    """Advance a state by `dt`, through all changes of mode on the way; NaN where these have no end.

    A trial step that violates a guard is made shorter by Newton's method on the guard, kept between a step that was too
    short and one that was too long, until it ends on the change. The derivative of the instant of the change is that
    of the guard over its rate, so forward derivatives pass with the right jump.

    **Arguments:**

    - `tableau`: the method.
    - `scene_at`: the scene as it is driven at a time.
    - `t`, `dt`: start and length of the step [s].
    - `y`, `mode`: consistent at `t`.
    """
    landed, rest = _LANDED * dt, jnp.asarray(_REST, y.q.dtype)

    def go_on(at: _PartialStep) -> Bool[Array, ""]:
        return (at.left > 0) & (at.trials < _MOST)

    def attempt(at: _PartialStep) -> _PartialStep:
        def field(t: Array, y: State) -> State:
            return _field(t, y, scene_at(t), at.mode)

        whole = at.trial >= at.left
        length = jnp.where(whole, at.left, at.trial)
        y1 = rosenbrock_step(tableau, field, at.t, length, at.y, pivot=True).y1
        t1 = at.t + length
        slope = field(t1, y1)
        guards, falls = jax.jvp(lambda t, y: _guards(t, y, scene_at(t), at.mode), (t1, y1), (jnp.ones_like(t1), slope))
        falls = _constant(falls)
        away = -_constant(guards) / jnp.where(falls < 0, falls, -1.0)
        fired = (falls < 0) & (jnp.abs(away) <= landed)
        missed = (guards < 0) & ~fired
        over = jnp.any(missed)
        lands = ~over & jnp.any(fired)
        passes = lands | (~over & whole)

        # The instant of the first guard that fires; its value is that of the trial, its derivative that of the guard.
        first = fired & (away == jnp.min(jnp.where(fired, away, jnp.inf)))
        late = jnp.sum(jnp.where(first, (_constant(guards) - guards) / jnp.where(first, falls, 1.0), 0.0))
        late = jnp.where(lands, late / jnp.maximum(jnp.sum(first), 1), 0.0)
        there = jtu.tree_map(lambda y, f: y + late * f, y1, slope)
        t_there, left = t1 + late, at.left - length - late
        after, mode = _switch(t_there, there, scene_at(t_there), at.mode, fired & lands, rest)
        after = jtu.tree_map(lambda a, b: jnp.where(lands, a, b), after, there)

        lower, upper = jnp.where(over, at.lower, length), jnp.where(over, length, at.upper)
        ahead = jnp.where(falls < 0, length + away, jnp.inf)
        newton = jnp.min(jnp.where(missed | ~over, ahead, jnp.inf))
        inside = (newton > lower) & (newton < upper) & ((at.trials < _NEWTON) | (at.trials % 2 == 0))
        trial = jnp.where(inside, newton, 0.5 * (lower + upper))
        retry = at._replace(lower=lower, upper=upper, trial=trial)
        onward = _PartialStep(
            t_there, left, after, jnp.where(lands, mode, at.mode), jnp.zeros_like(dt), left, left, at.trials
        )
        moved = jtu.tree_map(lambda a, b: jnp.where(passes, a, b), onward, retry)
        lengths = {name: _constant(getattr(moved, name)) for name in ("lower", "upper", "trial")}
        return moved._replace(**lengths, trials=at.trials + 1)

    begin = _PartialStep(t, dt, y, mode, jnp.zeros_like(dt), dt, dt, jnp.zeros((), int))
    end = jax.lax.while_loop(go_on, attempt, begin)
    stuck = end.left > 0
    return jtu.tree_map(lambda x: jnp.where(stuck, jnp.nan, x), end.y), end.mode
