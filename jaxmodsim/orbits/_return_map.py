"""The return map of a scene with its derivatives, and the equations of a periodic orbit."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..scene import Scene, State, read_element, replace_elements
from ..simulation import Trajectory, outcome_messages, simulate

# Period [s] as a function of the parameters of the scene.
PeriodFn: TypeAlias = Callable[[PyTree], Array | float]
# A function of q and qd that is zero at the start of an orbit.
Section: TypeAlias = Callable[[Array, Array], Array | float]

MAX_STEPS, MAX_EVENTS = 65536, 4096


class OrbitError(RuntimeError):
    """The search for an orbit or equilibrium fails, or finds one of a family; the message says why."""


class OrbitProblem(eqx.Module):
    """The problem of a periodic orbit.

    - `phase`: start time of forced orbits, in periods.
    - `rtol`, `atol`: tolerances of the runs.
    - `normal`, `anchor`: the plane in which an orbit of unknown period begins: `normal . (x - anchor) = 0`. A
      `section` replaces the plane.
    - `cuts`: starts of the segments, in periods after the start of the orbit; the first is 0.
    - `period`: of a forced orbit, a function of the parameters of the scene; None if the period is unknown.
    - `parameters`: names of the numbers of the scene that are unknowns.
    - `free`: projector on the shifts of coordinates under which the scene is invariant, along which the orbit may
      advance. `pinned`: projector on these and on the directions in which elements stick throughout; in all of them
      the orbit begins at `anchor`. Shape `[n, n]` each.
    - `held`: names of the friction elements that stick throughout.

    `anchored` sets plane, segments, projectors and `held`, which are empty before.
    """

    scene: Scene
    phase: Float[Array, ""]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    period: PeriodFn | None = eqx.field(static=True)
    section: Section | None = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)
    normal: Float[Array, " n"] = eqx.field(default_factory=lambda: jnp.zeros(0))
    anchor: Float[Array, " n"] = eqx.field(default_factory=lambda: jnp.zeros(0))
    cuts: Float[Array, " segments"] = eqx.field(default_factory=lambda: jnp.zeros(0))
    free: Float[Array, "n n"] = eqx.field(default_factory=lambda: jnp.zeros((0, 0)))
    pinned: Float[Array, "n n"] = eqx.field(default_factory=lambda: jnp.zeros((0, 0)))
    held: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def autonomous(self) -> bool:
        """Whether the period is unknown."""
        return self.period is None

    @property
    def spans(self) -> Float[Array, "segments 2"]:
        """Start and end of each segment, in periods."""
        return self.phase + jnp.stack([self.cuts, jnp.append(self.cuts[1:], 1.0)], axis=1)

    @property
    def values(self) -> np.ndarray:
        """Values of the parameters in the scene."""
        return np.array([read_element(self.scene, name) for name in self.parameters])

    def with_values(self, values: Array | np.ndarray) -> Scene:
        """The scene with other values of the parameters."""
        return replace_elements(self.scene, dict(zip(self.parameters, values, strict=True)))

    def period_of(self, scene: Scene, unknown: Array) -> Array:
        """Period [s]."""
        return unknown if self.period is None else jnp.asarray(self.period(scene.params), unknown.dtype)

    def closure(self, start: Array | np.ndarray, end: Array | np.ndarray) -> Array | np.ndarray:
        """Zero if the end is the start plus an allowed advance, and the start is at the anchor in pinned directions."""
        miss = end - start
        return miss - self.free @ miss + self.pinned @ (start - self.anchor)

    def plane(self, x: Array, dof: int) -> Array:
        """Zero at an allowed start of an orbit of unknown period."""
        if self.section is not None:
            return jnp.asarray(self.section(x[:dof], x[dof : 2 * dof]), x.dtype)
        return jnp.sum(self.normal * (x - self.anchor))


def pack(state: State) -> Float[Array, " n"]:
    """Coordinates, velocities and states of effects in one vector."""
    return ravel_pytree(tuple(state))[0]


def unpack(scene: Scene, x: Array, dof: int) -> State:
    """The inverse of `pack`."""
    shape = tuple(State(x[:dof], x[:dof], scene.initial_state(x[:dof])))
    return State(*ravel_pytree(shape)[1](x))


class Returned(NamedTuple):
    """The state after a segment, with derivatives.

    - `x`: state at the end, shape `[n]`. `by`: its derivatives by start, period and parameters, `[n, unknowns]`.
    - `plane`, `plane_by`: value and gradient of `OrbitProblem.plane` at the start.
    - `code`: result code of the run.
    """

    x: Float[Array, " n"]
    by: Float[Array, "n unknowns"]
    plane: Float[Array, ""]
    plane_by: Float[Array, " n"]
    code: Array


def run_segment(
    problem: OrbitProblem,
    scene: Scene,
    x: Array,
    period: Array,
    span: Array,
    dof: int,
    times: Array | None = None,
    max_steps: int = 16384,
) -> Trajectory:
    """The run from x over a segment, saved at these times [s], clipped to the segment, or at its end alone."""
    t0, t1 = span * period
    ts = None if times is None else jnp.clip(times, t0, t1)
    return run_between(problem, scene, unpack(scene, x, dof), (t0, t1), ts, max_steps=max_steps, throw=False)


def run_between(
    problem: OrbitProblem,
    scene: Scene,
    y: State,
    span: tuple[Array | float, Array | float],
    ts: Array | None,
    **options: Any,
) -> Trajectory:
    """The run from a state over a span of time [s], with the tolerances of the problem."""
    options |= {"rtol": problem.rtol, "atol": problem.atol, "max_events": MAX_EVENTS}
    return simulate(scene, y.q, y.qd, span[1], t0=span[0], z0=y.z, ts=ts, **options)


def end_of(run: Trajectory) -> Float[Array, " n"]:
    """The last state of a run."""
    return pack(jtu.tree_map(lambda a: a[-1], State(run.q, run.qd, run.z)))


@eqx.filter_jit
def _returned(problem: OrbitProblem, span: Array, unknowns: Array, dof: int) -> Returned:
    n = problem.anchor.shape[0]

    def map_(unknowns: Array) -> tuple[Array, tuple[Array, Array]]:
        scene = problem.with_values(unknowns[n + 1 :])
        period = problem.period_of(scene, unknowns[n])
        run = run_segment(problem, scene, unknowns[:n], period, span, dof, max_steps=MAX_STEPS)
        x = end_of(run)
        return x, (x, run.code)

    by, (x, code) = jax.jacfwd(map_, has_aux=True)(unknowns)
    plane, plane_by = jax.value_and_grad(problem.plane)(unknowns[:n], dof)
    return Returned(x, by, plane, plane_by, code)


class ShotOrbit(NamedTuple):
    """The equations of an orbit at given unknowns: starts of the segments, period and parameters.

    - `x`: starts, shape `[segments, n]`. `period`: [s]. `values`: of the parameters, `[parameters]`.
    - `maps`: derivatives of the state after each segment by the state before it, `[segments, n, n]`.
    - `flows`: rates of the state at the starts, `[segments, n]`, if the period is unknown.
    - `advance`: change of the state in a period along the shifts of the scene, `[n]`.
    - `residual`: of the equations, `[segments n]`, and one more for the plane if the period is unknown. `by`: their
      derivatives by starts, period (if unknown) and parameters.
    - `failure`: why the run ended early, or "".
    """

    x: np.ndarray
    period: float
    values: np.ndarray
    maps: np.ndarray
    flows: np.ndarray
    advance: np.ndarray
    residual: np.ndarray
    by: np.ndarray
    failure: str

    @property
    def value(self) -> float:
        """Value of the parameter along which a branch is followed, the last one."""
        return float(self.values[-1])

    @property
    def monodromy(self) -> np.ndarray:
        """Derivative of the state after a period by the state before it, `[n, n]`."""
        product = self.maps[0]
        for each in self.maps[1:]:
            product = each @ product
        return product

    @property
    def unknowns(self) -> np.ndarray:
        """The unknowns, in the order of the columns of `by`."""
        period = [self.period] if len(self.residual) > self.x.size else []
        return np.array([*self.x.ravel(), *period, *self.values])

    def scaled(self, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives by the unknowns in their scales, and residuals.

        Rows of the state have the scale of the state, that of the plane its largest derivative.
        """
        size = self.x.size
        rows = np.append(scale[:size], np.max(np.abs(self.by[size:] * scale), axis=1, initial=1e-300))
        return self.by * scale / rows[:, None], self.residual / rows


class SettledState(NamedTuple):
    """The start of the search.

    - `x`: starts of the segments, `[segments, n]`. `cuts`: their times, in periods after the first.
    - `period`: [s].
    - `scale`: magnitudes of the state and the period, `[n + 1]`.
    - `held`: names of the friction elements that stick throughout. `moving`: a sentence on coordinates that advance.
    """

    x: np.ndarray
    cuts: np.ndarray
    period: float
    scale: np.ndarray
    held: tuple[str, ...]
    moving: str = ""


def evaluate(problem: OrbitProblem, x: np.ndarray, period: float, values: np.ndarray, dof: int) -> ShotOrbit:
    """The equations of an orbit at these unknowns."""
    (count, n), spans = x.shape, np.asarray(problem.spans)
    starts = [jnp.asarray([*y, period, *values]) for y in x]
    # The shape does not depend on the number of segments: one program serves any number.
    alone = replace(problem, cuts=problem.cuts[:0], held=())
    made = jax.device_get([_returned(alone, span, y, dof) for span, y in zip(problem.spans, starts, strict=True)])
    by = np.zeros((x.size, x.size + 1 + len(values)))
    for i, each in enumerate(made):
        rows, columns, later = (slice(j * n, (j + 1) * n) for j in (i, i, (i + 1) % count))
        by[rows, columns], by[rows, x.size :] = each.by[:, :n], each.by[:, n:]
        by[rows, later] -= np.eye(n)
    free, pinned = np.asarray(problem.free), np.asarray(problem.pinned)
    last, miss = slice(-n, None), np.array([each.x for each in made]) - np.roll(x, -1, axis=0)
    advance = free @ miss[-1]
    by[last] -= free @ by[last]
    by[last, :n] += pinned
    miss[-1] = problem.closure(x[0], made[-1].x)
    residual = np.ravel(miss)
    by_period = np.array([each.by[:, n] for each in made]) / np.diff(spans)
    if problem.autonomous:
        by = np.vstack([by, np.append(made[0].plane_by, np.zeros(by.shape[1] - n))])
        residual = np.append(residual, made[0].plane)
    else:
        by = np.delete(by, x.size, axis=1)
        period = float(problem.period_of(problem.with_values(values), jnp.asarray(period)))
    codes = [int(each.code) for each in made if each.code != 0]
    failure = outcome_messages(problem.scene, dof)[codes[0]] if codes else ""
    if not failure and not (np.isfinite(by).all() and np.isfinite(residual).all()):
        failure = "The run or its derivatives are not finite."
    maps = np.array([each.by[:, :n] for each in made])
    return ShotOrbit(x, period, values, maps, np.roll(by_period, 1, axis=0), advance, residual, by, failure)
