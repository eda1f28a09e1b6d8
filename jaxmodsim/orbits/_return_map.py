"""The return map of a scene, its derivatives, and the equations of an orbit."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..scene import Scene, State, read_element, replace_elements
from ..simulation import Trajectory, outcome_messages, simulate

# Period [s] from the parameters of the scene.
PeriodFn: TypeAlias = Callable[[PyTree], Array | float]
# A function of q and qd that is zero where an orbit begins.
Section: TypeAlias = Callable[[Array, Array], Array | float]

MAX_STEPS, MAX_EVENTS = 65536, 4096


class OrbitError(RuntimeError):
    """No periodic orbit, or not one alone; the message says why, and what to do."""


class OrbitProblem(eqx.Module):
    """What has to return to itself.

    - `phase`: time at which forced orbits begin, in periods.
    - `period`: of a forced orbit, from the parameters of the scene; None where the period is unknown.
    - `cuts`: where the segments of the period begin, in periods after its start; the first at 0.
    - `parameters`: numbers of the scene that are unknowns too.
    - `normal`, `anchor`: the plane in which an orbit of unknown period begins: `normal . (x - anchor) = 0`. With a
      `section` that takes its place.
    - `free`: projector on the shifts of coordinates under which the scene stays the same; along them the orbit may
      advance. `pinned`: projector on these and on the directions in which elements stick throughout; in all of them
      the orbit begins at `anchor`. Shape `[n, n]` each.
    - `held`: names of the friction elements that stick throughout.
    """

    scene: Scene
    phase: Float[Array, ""]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    normal: Float[Array, " n"]
    anchor: Float[Array, " n"]
    cuts: Float[Array, " segments"]
    period: PeriodFn | None = eqx.field(static=True)
    section: Section | None = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)
    free: Float[Array, "n n"]
    pinned: Float[Array, "n n"]
    held: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def autonomous(self) -> bool:
        """Whether the period is unknown."""
        return self.period is None

    @property
    def spans(self) -> Float[Array, "segments 2"]:
        """Where the segments begin and end, in periods."""
        return self.phase + jnp.stack([self.cuts, jnp.append(self.cuts[1:], 1.0)], axis=1)

    @property
    def values(self) -> np.ndarray:
        """Values that the parameters have in the scene."""
        return np.array([read_element(self.scene, name) for name in self.parameters])

    def with_values(self, values: Array | np.ndarray) -> Scene:
        """The scene with other values of the parameters."""
        return replace_elements(self.scene, dict(zip(self.parameters, values, strict=True)))

    def period_of(self, scene: Scene, unknown: Array) -> Array:
        """Period [s]."""
        return unknown if self.period is None else jnp.asarray(self.period(scene.params), unknown.dtype)

    def closure(self, start: Array | np.ndarray, end: Array | np.ndarray) -> Array | np.ndarray:
        """Zero where the state at the end is that at the start, but for the advance, and the start is in its place."""
        miss = end - start
        return miss - self.free @ miss + self.pinned @ (start - self.anchor)

    def plane(self, x: Array, dof: int) -> Array:
        """Zero where an orbit of unknown period may begin."""
        if self.section is not None:
            return jnp.asarray(self.section(x[:dof], x[dof : 2 * dof]), x.dtype)
        return jnp.sum(self.normal * (x - self.anchor))


def pack(state: State) -> Float[Array, " n"]:
    """Coordinates, velocities and own states of effects in one vector."""
    return ravel_pytree(tuple(state))[0]


def unpack(scene: Scene, x: Array, dof: int) -> State:
    """The state in such a vector."""
    shape = tuple(State(x[:dof], x[:dof], scene.initial_state(x[:dof])))
    return State(*ravel_pytree(shape)[1](x))


class Returned(NamedTuple):
    """The state after a segment, and derivatives.

    - `x`: at its end, shape `[n]`; `by`: its derivatives by start, unknown period and parameters, `[n, unknowns]`.
    - `plane`, `plane_by`: of `OrbitProblem.plane` at its start.
    - `code`: how the run ended.
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
    """The run from x over a segment; at these times [s] as far as they are inside it, else at its end alone."""
    y = unpack(scene, x, dof)
    t0, t1 = span * period
    return simulate(
        *(scene, y.q, y.qd, t1),
        t0=t0,
        z0=y.z,
        ts=None if times is None else jnp.clip(times, t0, t1),
        rtol=problem.rtol,
        atol=problem.atol,
        max_steps=max_steps,
        max_events=MAX_EVENTS,
        throw=False,
    )


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
    """Starts of the segments, a period [s] and values of the parameters, and what becomes of them in a period.

    - `x`: shape `[segments, n]`; `values`: `[parameters]`.
    - `maps`: derivatives of the state after each segment by the state before it, `[segments, n, n]`.
    - `flows`: rates of the state at the starts, `[segments, n]`; of unknown period.
    - `advance`: change of the state in a period along the shifts of the scene, `[n]`.
    - `residual`: of the equations, `[segments n]`, and one more with the plane; `by`: their derivatives by starts,
      period (of unknown period alone) and parameters.
    - `failure`: how the run ended early; "" where it did not.
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
        """Of the parameter along which a branch is followed, the last one."""
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
        """What the columns of `by` belong to."""
        period = [self.period] if len(self.residual) > self.x.size else []
        return np.array([*self.x.ravel(), *period, *self.values])


class SettledState(NamedTuple):
    """Where the search starts.

    - `x`: states at the begins of the segments, `[segments, n]`; `cuts`: when these are, in periods after the first.
    - `period`: [s].
    - `scale`: magnitudes of the state and the period, `[n + 1]`.
    - `held`: names of the friction elements that stick throughout; `moving`: a sentence on coordinates that move on.
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
    # Of a shape that does not depend on how many segments there are: one program serves any number of them.
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
