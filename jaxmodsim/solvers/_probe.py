"""A probe: one tangent beside the state, whose error limits the steps of a differentiated run."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from .._core.arrays import Real
from ._over_steps import filled, is_none, split
from .events._state import EventState

# Change in a number that is zero, which has no magnitude.
_OF_ZERO = 1e-3
# Admissible error of the tangent at rest, in parts of `rtol`; the factor by which it is larger in motion, where the
# error of the state limits the steps, too, but not in brief contacts; the error of the state in motion, in parts of its
# tolerance.
_AT_REST, _IN_MOTION, _MOVES = 0.1, 150.0, 0.01
# Least magnitude of a tangent, in parts of the largest in its array.
_OF_ARRAY = 1e-3
# A tangent that is small up to a kink of the field grows in proportion to the step over it, as does its error, whatever
# the step. If at this pace it is far larger after this part of a late step, it counts as that large. The length of late
# steps decreases by a factor with each step.
_SOON, _LATE = 0.01, 0.9
# Errors of a tangent that are noise: in parts of `atol`, in roundings of the state, and in roundings of the tangent.
_OF_ATOL, _ROUNDINGS, _RESOLVED = 1e-6, 16.0, 64.0
# At rest forces cancel up to their rounding, the only error of the state: as an error of the tangent it is at most this
# many times as large. It is no more than this part of the tolerance of the state.
_OF_ERROR, _OF_TOLERANCE = 8.0, 0.1
# Over a kink of the field, as that of |v|, the error of a tangent falls in proportion to the step, and steps may end at
# the resolution of time. Shorter than so many of the shortest, a step has this tolerance, in parts of the root of a
# rounding: 1 % in float32. A larger error still ends the run: without this bound some derivatives were wrong by half.
_SHORT, _OVER_A_KINK = 8.0, 32.0


class ProbeTangent(NamedTuple):
    """The tangents of the state and of the solver's state, and the magnitudes of the former so far.

    Errors are relative to the magnitudes: the largest values, or, with `elapsed`, means over this time since the start,
    power means with the exponent 1/2. Through a stiff contact a tangent moves as the force does, thousands of times
    larger than behind it, and parts cancel. An error that is small beside the peak would be most of what remains.
    """

    tangent: tuple[PyTree, PyTree]
    magnitude: PyTree
    elapsed: Array | None
    # Length [s] of the late steps; see `_LATE`.
    length: Array
    # 0 in a first step with a projection, else 1. That projection changes the tangent by a jump, which is no error and
    # does not shrink with the step.
    counts: Array


class Probed(NamedTuple):
    """A state with a probe beside it."""

    y: PyTree
    probe: ProbeTangent


def without_probe(y: PyTree) -> PyTree:
    """The state alone."""
    return y.y if isinstance(y, Probed) else y


def direction(step: PyTree, y0: PyTree, asked: tuple[PyTree, PyTree], controller: PyTree) -> tuple[PyTree, PyTree]:
    """A change of the differentiated numbers of a step and of the initial state, with random signs and factors.

    It has their magnitude, for a state at least about `atol/rtol`: a smaller tangent would pass for noise.
    """
    rng, control = np.random.default_rng(35), _pid(controller)[0]
    resolved = lax.stop_gradient(control.atol / (control.atol + control.rtol))

    def change(least: Any, is_asked: Any, x: Any) -> Any:
        if is_asked is None:
            return None
        part = np.exp(rng.uniform(-0.7, 0.7, x.shape)) * rng.choice((-1.0, 1.0), x.shape)
        size = jnp.abs(lax.stop_gradient(x))
        zero, size = _OF_ZERO * jnp.maximum(jnp.max(size), 1.0), jnp.where(size > 0, jnp.maximum(size, least), 0.0)
        return jnp.asarray(part, x.dtype) * jnp.where(size > 0, size, zero).astype(x.dtype)

    of_step = jtu.tree_map(partial(change, 0.0), asked[0], step, is_leaf=is_none)
    return of_step, jtu.tree_map(partial(change, resolved), asked[1], y0, is_leaf=is_none)


def start(
    t0: Array,
    y0: PyTree,
    solver_state: PyTree,
    change: PyTree,
    project: Callable[[Array, PyTree], PyTree] | None,
    brief: bool,
) -> Probed:
    """The initial state of a run, and its change after the projection; `brief` asks for means as magnitudes."""
    tangent = filled(change, y0)
    if project is not None:
        numbers, rest = eqx.partition(y0, eqx.is_inexact_array)
        moved = lambda x: eqx.filter(project(t0, eqx.combine(x, rest)), eqx.is_inexact_array)  # noqa: E731
        tangent = jax.jvp(moved, (numbers,), (tangent,))[1]
    tangent = _moving(tangent), filled(None, solver_state)
    counts = jnp.asarray(1.0 if project is None else 0.0, t0.dtype)
    magnitude, elapsed = jtu.tree_map(jnp.abs, _integrated(tangent[0])), jnp.zeros_like(counts) if brief else None
    return Probed(y0, ProbeTangent(tangent, magnitude, elapsed, jnp.zeros_like(counts), counts))


class ProbedStep(NamedTuple):
    """A step of a solver that advances the probe, too."""

    step: PyTree
    change: PyTree
    controller: PyTree

    def __call__(self, t0: Array, t1: Array, y: Probed, state: PyTree, jump: Real) -> tuple[Any, ...]:
        """The step; its error estimate is a pair: that of the state, and the size of that of the probe."""
        held, probe = y.y, y.probe
        numbers, rest = split(self.change, self.step)
        moving, others = eqx.partition((_moving(held), state), eqx.is_inexact_array)

        def advance(numbers: PyTree, moving: PyTree) -> tuple[PyTree, PyTree]:
            (y, state), step = eqx.combine(moving, others), eqx.combine(numbers, rest)
            y1, error, dense, state1, result = step(t0, t1, _with_moving(held, y), state, jump)
            of_probe, _ = eqx.partition((_moving(y1), state1), eqx.is_inexact_array)
            return (of_probe, error), (y1, error, dense, state1, result)

        (_, _), (tangent, error_of_probe), (y1, error, dense, state1, result) = jax.jvp(
            advance, (numbers, moving), (self.change, probe.tangent), has_aux=True
        )
        now, elapsed, h = jtu.tree_map(jnp.abs, _integrated(tangent[0])), probe.elapsed, jnp.abs(t1 - t0)
        if elapsed is None:
            magnitude = jtu.tree_map(jnp.maximum, now, probe.magnitude)
        else:
            elapsed = elapsed + h
            part = h / elapsed
            magnitude = jtu.tree_map(
                lambda d, x: jnp.square((1.0 - part) * jnp.sqrt(x) + part * jnp.sqrt(d)), now, probe.magnitude
            )
        ends = jtu.tree_map(lambda a, b: jnp.maximum(jnp.abs(a), jnp.abs(b)), _integrated(held), _integrated(y1))
        late = jnp.maximum(h, _LATE * probe.length)

        def scale(magnitude: Array, before: Array, x0: Array, x1: Array) -> Array:
            soon = jnp.abs(x1 - x0) * (_SOON * late / h)
            return jnp.where(before < _OF_ARRAY * soon, jnp.maximum(magnitude, soon), magnitude)

        scales = jtu.tree_map(scale, magnitude, probe.magnitude, _integrated(probe.tangent[0]), _integrated(tangent[0]))
        errors = jnp.where(
            probe.counts > 0, self._size((t0, t1), error, error_of_probe, scales, ends, elapsed is not None), 0.0
        )
        after = ProbeTangent(tangent, magnitude, elapsed, late, jnp.ones_like(probe.counts))
        return Probed(y1, after), (error, errors), dense, state1, result

    def _size(
        self, times: tuple[Array, Array], error: PyTree, of_probe: PyTree, magnitude: PyTree, y: PyTree, brief: bool
    ) -> Array:
        """Size of the probe's error in parts of its tolerance."""
        control = _pid(self.controller)[0]
        rtol, atol = lax.stop_gradient((control.rtol, control.atol))
        (t0, t1), dtmin = times, 0.0 if control.dtmin is None else control.dtmin
        shortest = jnp.maximum(dtmin, float(jnp.finfo(t0.dtype).eps) * jnp.maximum(jnp.abs(t0), jnp.abs(t1)))
        short = lax.stop_gradient(t1 - t0 < _SHORT * shortest)
        more = 0.0 if brief else _IN_MOTION - 1.0

        def size(of_state: Array, of_tangent: Array, magnitude: Array, y: Array) -> Array:
            of_state, tolerance = jnp.abs(of_state), atol + rtol * y
            moves = jnp.minimum(1.0, of_state / (_MOVES * tolerance))
            eps = float(jnp.finfo(y.dtype).eps)
            resolved = jnp.where(short, _OVER_A_KINK * eps**0.5, _RESOLVED * eps)
            relative = jnp.maximum(_AT_REST * (1.0 + more * moves) * rtol, resolved)
            tangent = jnp.maximum(magnitude, _OF_ARRAY * jnp.max(magnitude))
            noise = _OF_ATOL * atol + _ROUNDINGS * eps * y
            noise = noise + jnp.minimum(_OF_ERROR * of_state, _OF_TOLERANCE * tolerance)
            return jnp.sqrt(jnp.mean(jnp.square(of_tangent / (relative * tangent + noise))))

        return jnp.max(jnp.stack(jtu.tree_leaves(jtu.tree_map(size, error, of_probe, magnitude, y))))


class ProbedController(NamedTuple):
    """A step size controller for diffrax's loop, with the error of the probe in its norm."""

    controller: PyTree

    def adapt_step_size(
        self, t0: Real, t1: Real, y0: Probed, y1: Probed, args: PyTree, error: PyTree, order: Real, state: PyTree
    ) -> tuple[Any, ...]:
        """See `diffrax.AbstractStepSizeController`."""
        of_state, of_probe = error

        def with_probe(x: PyTree) -> PyTree:
            if not _is_pid(x):
                return x
            norm: Callable[[PyTree], Array] = x.norm  # of one number its size
            return eqx.tree_at(lambda x: x.norm, x, lambda scaled: norm(jnp.maximum(norm(scaled), of_probe)))

        controller = jtu.tree_map(with_probe, self.controller, is_leaf=_is_pid)
        return controller.adapt_step_size(t0, t1, y0.y, y1.y, args, of_state, order, state)


def has_error_control(controller: PyTree) -> bool:
    """Whether an error estimate determines the steps."""
    return len(_pid(controller)) == 1


def _pid(controller: PyTree) -> list[dfx.PIDController]:
    return [x for x in jtu.tree_leaves(controller, is_leaf=_is_pid) if _is_pid(x)]


def _is_pid(x: object) -> bool:
    return isinstance(x, dfx.PIDController)


def _integrated(y: PyTree) -> PyTree:
    """The part of the state that has an error estimate."""
    return y.y if isinstance(y, EventState) else y


def _moving(y: PyTree) -> PyTree:
    """The state without the log of events, which no other value depends on."""
    return y._replace(log=None) if isinstance(y, EventState) else y


def _with_moving(y: PyTree, moving: PyTree) -> PyTree:
    return moving._replace(log=y.log) if isinstance(y, EventState) else moving
