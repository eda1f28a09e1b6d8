"""The way through an event: to the root in the old mode, through the reset, and back in the new mode."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..._core.compat import AVAILABLE, eqxi
from ._state import Landing

# Factor by which the distance to a root in the step and in the passage may differ.
LATITUDE = 4.0

# Evaluations: at the end of the step, halfway, at the root; after the reset there, halfway, at the end of the step.
_ROOT, _RESET, _LAST, _COUNT = 2, 3, 4, 6
# Position of the next evaluation, in ways from the end of the step, or from the root; at the root the remaining way.
_SHARES = (0.5, 1.0, 0.0, -0.5, -1.0, 0.0)

_constant = jax.lax.stop_gradient


class Landed(NamedTuple):
    """End of a step on an event.

    - `t`, `y`, `mode`: the end of the step.
    - `first`: marks the guard whose root is the event, shape `[guards]`.
    - `fall`: the value of that guard at its root, and its rate along the motion; constant.
    - `on_root`: whether it has a root.
    - `near`: the largest distance of the root [time].
    - `earliest`: lower bound of the time of the event. `chained`: whether it is the time of a reset just before.
    """

    t: Float[Array, ""]
    y: PyTree
    mode: PyTree
    first: Bool[Array, " guards"]
    fall: tuple[Float[Array, ""], Float[Array, ""]]
    on_root: Bool[Array, ""]
    near: Float[Array, ""]
    earliest: Float[Array, ""]
    chained: Bool[Array, ""]


class Passage(NamedTuple):
    """An event.

    - `t`: time of the event.
    - `before`: y before the reset; the mode is that of the step.
    - `after`: y and mode after it, and the rate of y.
    - `y`, `guards`: y at the end of the step, and the guards there.
    """

    t: Float[Array, ""]
    before: PyTree
    after: tuple[PyTree, PyTree, PyTree]
    y: PyTree
    guards: Float[Array, " guards"]


class _Place(NamedTuple):
    """State between two evaluations: the next point, the origin of this half of the way, and its length."""

    t: Float[Array, ""]
    y: PyTree
    mode: PyTree
    origin: tuple[Float[Array, ""], PyTree]
    way: Float[Array, ""]
    on_root: Bool[Array, ""]


def pass_event(
    landed: Landed,
    evaluate: Callable[[Array, PyTree, PyTree, PyTree], tuple[PyTree, Float[Array, " guards"]]],
    args: tuple[PyTree, PyTree, PyTree],
    reset: Callable[[Array, PyTree], tuple[PyTree, PyTree]],
) -> Passage:
    """Carry a state from the end of a step to the root of a guard, reset it, and carry it back.

    The way to the root is as short as the error of the landing. Its first and second derivatives are those of the time
    of the event: it takes two Newton steps with one rate, on flows of second order.

    A loop evaluates field and guards, so that they are compiled once, and differentiated once. Reverse mode evaluates
    them again, because their residuals are hundreds of numbers.

    **Arguments:**

    - `landed`: the end of the step.
    - `evaluate`: `evaluate(t, y, mode, args)` -> the rate of y, and the guards.
    - `args`: arguments before the event, on the way back, and at the end of the step.
    - `reset`: `reset(t, y)` -> y and mode after the event.
    """
    level, rate = landed.fall

    @partial(jax.checkpoint, prevent_cse=False)
    def onward(place: _Place, turn: tuple[Int[Array, ""], Float[Array, ""]]) -> tuple[_Place, PyTree]:
        i, share = turn
        t, y, mode = place[:3]
        begins, at_root, behind = (i == 0) | (i == _RESET), i == _ROOT, i >= _RESET
        before = y
        y, mode = jax.lax.cond(i == _RESET, lambda: reset(t, y), lambda: (y, mode))
        origin = choose(begins, (t, y), place.origin)
        there = choose(i == _COUNT - 1, args[2], choose(behind, args[1], args[0]))
        rates, guards = evaluate(t, y, mode, there)
        newton = (level - jnp.sum(jnp.where(landed.first, guards, 0.0))) / rate
        # After a reset a guard fires late: at its root since then, or at the reset if that has violated it.
        back, aim = landed.earliest - landed.t, _constant(newton)
        reach = (jnp.abs(aim) <= LATITUDE * landed.near) | (landed.chained & (aim <= 0))
        here = landed.on_root & reach & _constant(t + newton >= landed.earliest)
        on_root = jnp.where(i == 0, here, place.on_root)
        newton = jnp.where(on_root, newton, 0.0)
        # In a flight that time hardly resolves the rate changes on the way, and the second step would lead back.
        diverges = at_root & (jnp.abs(_constant(newton)) > jnp.abs(_constant(place.way)))
        newton = jnp.where(diverges, newton - _constant(newton), newton)
        way = jnp.where(i == 0, jnp.where(landed.chained & ~here, back, newton), place.way)
        whole = way + newton
        whole = jnp.where(_constant(landed.t + whole < landed.earliest), back, whole)
        start, length = choose(at_root, ((landed.t, y), newton), (origin, share * way))
        way = jnp.where(at_root, whole, way)
        following = _Place(
            jnp.where(i == _LAST, landed.t, start[0] + jnp.where(at_root, way, length)),
            jtu.tree_map(lambda a, b: a + (length * b).astype(a.dtype), start[1], rates),
            mode,
            origin,
            way,
            on_root,
        )
        return following, (t, before, (y, mode, rates), guards)

    turns = jnp.arange(_COUNT), jnp.asarray(_SHARES, rate.dtype)
    begin = _Place(landed.t, landed.y, landed.mode, (landed.t, landed.y), jnp.zeros_like(rate), jnp.asarray(False))
    _, (t, before, (y, mode, rates), guards) = jax.lax.scan(onward, begin, turns)
    at, end = (lambda tree, i=i: jtu.tree_map(lambda x: x[i], tree) for i in (_RESET, _COUNT - 1))
    return Passage(at(t), at(before), (at(y), at(mode), at(rates)), end(y), end(guards))


def in_turn(
    way: Callable[..., tuple[Passage, PyTree, PyTree]],
    at_end: tuple[Array, PyTree, PyTree, Float[Array, " guards"]],
    landing: Landing,
    near: Float[Array, ""],
) -> tuple[Passage, Float[Array, " guards"], PyTree]:
    """The event of all guards that fire, the state after it with the derivatives of all their times.

    One reset for all of them, at the root of the first, decides. But each of the roots has a derivative of its own. So
    the guards also fire one by one, each at its root. If that gives the same modes and the same state, up to the motion
    within the landing distance, the state is that: their order has no effect, and the derivative is that of each order.

    **Arguments:**

    - `way`: `way(y, mode, first, fired)` -> the passage of an event, the rate of y before it, and more.
    - `at_end`: time, y, mode and guards at the end of the step.
    - `landing`: the guards that fire, and their roots. `near`: the landing distance [time].

    **Returns:**

    The passage; its time for each guard, with the derivative of its own root; and the third result of `way`.
    """
    (t, y, mode, guards), (fired, first, ahead) = at_end, landing[:3]
    n = fired.shape[0]
    if n == 1:
        passage, _, more = way(y, mode, first, fired)
        return passage, passage.t[None], more
    turns, other = jnp.arange(n)[:, None], jnp.arange(n)[None, :]
    earlier = (ahead[:, None] < ahead[None, :]) | ((ahead[:, None] == ahead[None, :]) & (turns < other))
    place = jnp.sum(earlier & fired[:, None], axis=0)
    one = fired[None, :] & (place[None, :] == turns)
    several = jnp.any(one[1])
    active = jnp.concatenate([jnp.ones(1, bool), jnp.any(one, axis=1) & several])
    nothing = Passage(t, y, (y, mode, y), y, guards), y, (near, near)

    def turn(at: tuple[PyTree, PyTree], marks: tuple[Array, Array, Array, Array]) -> tuple[PyTree, PyTree]:
        first, fires, acts, alone = marks
        # Under vmap, too, a turn without a guard costs nothing.
        some = eqxi.unvmap_any(acts) if "stored_steps" in AVAILABLE else acts
        out = jax.lax.cond(some, lambda: way(*at, first, fires), lambda: nothing)
        return choose(acts & alone, (out[0].y, out[0].after[1]), at), out

    every = (jnp.concatenate([first[None], one]), jnp.concatenate([fired[None], one]), active, jnp.arange(n + 1) > 0)
    (y, mode), out = jax.lax.scan(turn, (y, mode), every)
    passage, before, more = jtu.tree_map(lambda x: x[0], out)
    _, now, slope = passage.after

    def apart(a: Array, b: Array, before: Array, slope: Array, ends: Array, resets: Array) -> Bool[Array, ""]:
        """Whether two states differ by more than the motion within the landing distance, and rounding."""
        motion = near * (jnp.abs(before) + jnp.abs(slope)) + jnp.max(jnp.abs(ends - resets), axis=0)
        return jnp.any(jnp.abs(a - b) > LATITUDE * motion + 64.0 * float(jnp.finfo(a.dtype).eps) * jnp.abs(a))

    far = jtu.tree_leaves(jtu.tree_map(apart, passage.y, y, before, slope, out[0].y, out[0].after[0]))
    far += jtu.tree_leaves(jtu.tree_map(lambda a, b: jnp.any(a != b), now, mode))
    alike = several & ~jnp.any(jnp.stack(far))
    own = jnp.sum(jnp.where(one, out[0].t[1:, None], 0.0), axis=0)
    each = jnp.where(alike & fired, _constant(passage.t) + own - _constant(own), passage.t)
    return passage._replace(y=choose(alike, y, passage.y)), each, more


def choose(where: Bool[Array, ""], one: PyTree, other: PyTree) -> PyTree:
    """`one` or `other`, without an operation on leaves that are the same object in both."""
    return jtu.tree_map(lambda a, b: a if a is b else jnp.where(where, a, b), one, other)
