"""`periodic_orbit`: find a periodic orbit of a scene by shooting."""

from __future__ import annotations  # `help` shows types as they are written here

from dataclasses import dataclass, replace
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from .._core.arguments import as_float, as_whole, check_real
from .._core.arrays import is_known
from ..scene import Scene, State
from ._neutral import anchored, differs, moving_on, shifted
from ._newton import newton
from ._orbit import Extremes, PeriodicOrbit, describe
from ._return_map import (
    OrbitError,
    OrbitProblem,
    PeriodFn,
    Section,
    ShotOrbit,
    end_of,
    evaluate,
    pack,
    run_segment,
    unpack,
)
from ._settle import SettledState, cut, run_for, settled

# Default duration of the run that settles, in periods of the force.
_PERIODS = 20
# Relative singular value of the equations below which the orbit may be one of a family.
_FAMILY = 1e-7
# Time shift, in periods, that tests whether a scene depends on time.
_OTHER_TIME = 0.381966

_States: TypeAlias = ArrayLike | list[float] | list[list[float]]
Guess: TypeAlias = "PeriodicOrbit | tuple[_States, _States]"


def periodic_orbit(
    scene: Scene,
    guess: Guess,
    *,
    period: float | PeriodFn | None = None,
    section: Section | None = None,
    settle: float | None = None,
    segments: int = 1,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> PeriodicOrbit:
    """Find a periodic orbit by shooting: Newton's iteration on the run over one period, or over segments of it.

    Newton's iteration finds stable and unstable orbits, with derivatives through all events. The search starts with a
    simulation for `settle` seconds, which approaches stable orbits only.

    The state, the period and the extrema of the orbit have first derivatives by all numbers of the scene, forward and
    reverse, by the implicit function theorem: `jax.grad(lambda s: periodic_orbit(s, ...).period)(scene)`.

    **Arguments:**

    - `scene`: the `Scene`, in float64. Coordinates must return after a period. They may also advance by the same amount
      in each period if the scene is invariant under such a shift, such as a box that is pulled over a floor.
    - `guess`: `(q0, qd0)`, shape `[dof]` each; for a forced orbit also `[segments, dof]`, the starts of segments of
      equal duration. Or a `PeriodicOrbit`, for instance of another scene, at which Newton's iteration starts.
    - `period`: period [s] of a forced orbit, > 0, which begins at t = 0: a number, or a function of `params`, as in
      `lambda p: 2 * jnp.pi / p["omega"]`. None for a scene that is independent of time, whose period is an unknown.
    - `section`: `section(q, qd)` -> a number that is zero and rising at the start of an orbit of unknown period. By
      default the start is the middle of the longest phase without a change of modes, in slip if possible.
    - `settle`: duration [s] of the run from the guess, >= 0. For a forced orbit it is rounded to periods, by default
      20. For an orbit of unknown period it is required, unless the guess is an orbit, and the state must return in its
      second half.
    - `segments`: number of runs for the period, >= 1, whose starts are unknowns (multiple shooting). Use more for
      orbits so unstable that rounding errors at the start dominate after a period.
    - `rtol`, `atol`: tolerances of the runs, as for `simulate`.

    **Returns:**

    A `PeriodicOrbit`.

    **Raises:**

    - `ValueError` for invalid arguments, float32, and inside `jax.jit` or `jax.vmap`.
    - `OrbitError` if the iteration does not converge, the run does not return or comes to rest, the section is
      degenerate, the orbit is one of a family, or the scene depends on time with another period.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    orbit = jms.periodic_orbit(scene, ([0.0], [0.0]), settle=20.0)
    print(f"{orbit.period:.6f} s")
    ```

    ```text
    0.978509 s
    ```

    ??? cite "Reference"

        ```bibtex
        @book{leine2004dynamics,
            author={Leine, R. I. and Nijmeijer, H.}, title={Dynamics and Bifurcations of Non-Smooth Mechanical Systems},
            publisher={Springer}, year={2004},
        }
        ```
    """
    known = jtu.tree_map(jax.lax.stop_gradient, scene)
    problem, start, dof = prepare(known, guess, period, section, settle, rtol, atol, segments=segments)
    point = shoot(problem, start, dof)
    orbit, lowest, highest = describe(problem, point, dof)
    if is_known(*jtu.tree_leaves(scene)):
        return orbit
    return _with_derivatives(eqx.tree_at(lambda p: p.scene, problem, scene), point, orbit, (lowest, highest))


def prepare(
    scene: Scene,
    guess: Guess,
    period: float | PeriodFn | None,
    section: Section | None,
    settle: float | None,
    rtol: float,
    atol: float,
    parameters: tuple[str, ...] = (),
    segments: int = 1,
) -> tuple[OrbitProblem, SettledState, int]:
    """The problem of an orbit, a start with the magnitudes of all unknowns, and the number of coordinates.

    **Raises:**

    - `ValueError` for invalid arguments; `OrbitError` if the run does not settle.
    """
    check_known(scene, "periodic_orbit")
    _check_functions(period, section)
    relative, absolute = (
        jnp.asarray(as_float(x, name=name, lower=0.0), float) for name, x in (("rtol", rtol), ("atol", atol))
    )
    phase = jnp.zeros(())
    if isinstance(guess, PeriodicOrbit):
        phase = jax.lax.stop_gradient(guess.t0 / guess.period)
    number = (
        period if period is None or callable(period) else MultipleOfPeriod(as_float(period, name="period", lower=0.0))
    )
    problem = OrbitProblem(scene, phase, relative, absolute, number, section, parameters)
    count = as_whole(segments, name="segments")
    state = _state(scene, guess)
    dof = state.q.shape[-1]
    if isinstance(guess, PeriodicOrbit) and settle is None:
        start = cut(problem, guess.runs, float(guess.period), count)
    elif state.q.ndim == 2:
        start = _segment_starts(problem, state, count)
    else:
        start = settled(problem, state, _settle(problem, settle), section, count)
    state_scale, of_period = start.scale[:-1], start.scale[-1:] if problem.autonomous else []
    start = start._replace(scale=np.concatenate([*[state_scale] * count, of_period, np.ones(len(parameters))]))
    problem, start = anchored(problem, start, dof)
    if not isinstance(guess, PeriodicOrbit) and state.q.ndim == 1:
        # Along invariant shifts the orbit begins at the guess.
        x = start.x + np.asarray(problem.free) @ (np.asarray(pack(state)) - start.x[0])
        start, problem = start._replace(x=x), replace(problem, anchor=jnp.asarray(x[0]))
    return problem, start, dof


def _segment_starts(problem: OrbitProblem, states: State, count: int) -> SettledState:
    """A start from the states at the starts of all segments, of equal duration.

    **Raises:**

    - `ValueError` for another number of states, and if the period is unknown.
    """
    if problem.period is None or len(states.q) != count:
        raise ValueError(
            f"guess has {len(states.q)} states, which needs a forced orbit with as many segments, but segments is"
            f" {count}, and {'no period' if problem.period is None else 'a period'} was given."
        )
    period, cuts = float(problem.period(problem.scene.params)), np.arange(count) / count
    each = [jtu.tree_map(lambda a, i=i: a[i], states) for i in range(count)]
    t = [np.linspace(a, a + 1.0 / count, 257) * period for a in cuts]
    runs = [run_for(problem, state, times[0], times) for state, times in zip(each, t, strict=True)]
    x = np.array([np.asarray(pack(state)) for state in each])
    return cut(problem, runs, period, count)._replace(x=x, cuts=cuts)


@dataclass(frozen=True)
class MultipleOfPeriod:
    """A multiple of a period, which is a number [s] or a function of the parameters."""

    period: float | PeriodFn
    factor: float = 1.0

    def __call__(self, params: PyTree) -> Array | float:
        """The period [s]."""
        return self.factor * (self.period(params) if callable(self.period) else self.period)


def _settle(problem: OrbitProblem, settle: float | None) -> float:
    if settle is not None:
        return as_float(settle, name="settle", lower=None if problem.period is not None else 0.0)
    if problem.period is None:
        raise ValueError(
            "An orbit of unknown period needs settle, the duration [s] of the simulation that starts the search: some"
            " tens of periods for an orbit that attracts slowly. Pass period if the scene is forced."
        )
    return _PERIODS * float(problem.period(problem.scene.params))


def _state(scene: Scene, guess: Guess) -> State:
    if isinstance(guess, PeriodicOrbit):
        return jtu.tree_map(jax.lax.stop_gradient, guess.state)
    if not isinstance(guess, tuple | list) or len(guess) != 2:
        raise ValueError(f"guess must be (q0, qd0), as in ([0.0], [0.1]), or a PeriodicOrbit, but got {guess!r}.")
    for name, value in zip(("q0", "qd0"), guess, strict=True):
        check_real(value, name=f"guess, {name},")
    q, qd = (jnp.asarray(x, float) for x in guess)
    if q.ndim not in (1, 2) or not q.size or q.shape != qd.shape:
        raise ValueError(
            "guess must have q0 and qd0 of the shape [dof], or [segments, dof], but they have"
            f" {q.shape} and {qd.shape}."
        )
    return State(q, qd, scene.initial_state(q) if q.ndim == 1 else jax.vmap(scene.initial_state)(q))


def check_known(scene: Scene, name: str) -> None:
    """Check that a scene has concrete numbers in float64.

    **Raises:**

    - `ValueError` that mentions the function `name`.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"{name} needs a Scene, but a {type(scene).__name__} was given.")
    if not is_known(*jtu.tree_leaves(scene)):
        raise ValueError(
            f"{name} needs concrete numbers, but those of the scene are traced by jax.jit or jax.vmap: call it outside"
            " of these. jax.grad and jax.jacfwd work."
        )
    kind = jnp.result_type(float, *jtu.tree_leaves(scene))
    if kind != jnp.float64 or any(x.dtype == jnp.float32 for x in jtu.tree_leaves(scene)):
        raise ValueError(
            f"{name} needs float64, because errors of float32 exceed the differences between neighbouring solutions."
            " Call"
            ' jax.config.update("jax_enable_x64", True) before you create the scene.'
        )


def _check_functions(period: object, section: object) -> None:
    if section is not None and not callable(section):
        raise ValueError(f"section must be a function of q and qd, but {section!r} was given.")
    if section is not None and period is not None:
        raise ValueError(
            "section is for orbits of unknown period; a forced orbit begins at t = 0. Pass section or period."
        )


def shoot(problem: OrbitProblem, start: SettledState, dof: int) -> ShotOrbit:
    """The orbit near the start, at the values of the parameters in the scene.

    **Raises:**

    - `OrbitError` if there is none, if the scene depends on time with another period, or if there is a family.
    """
    try:
        point, _ = newton(problem, start.x, start.period, problem.values, dof, start.scale)
    except OrbitError as error:
        raise OrbitError(f"{error}{start.moving}") from error
    _refuse_clock(problem, point, start.scale, dof)
    advance = point.advance[:dof]
    if np.any(advance) and differs(point, shifted(problem, point, point.advance, dof), start.scale):
        raise OrbitError(f"The run does not continue as an orbit.{moving_on(problem.scene, advance, 0.0 * advance)}")
    _refuse_family(problem, point, start.scale, dof)
    return point


def _refuse_clock(problem: OrbitProblem, point: ShotOrbit, scale: np.ndarray, dof: int) -> None:
    """Check that the orbit returns at other times: a period later, or at any time if the period is unknown.

    **Raises:**

    - `OrbitError` if the scene depends on time with another period.
    """
    moved = problem.phase + (_OTHER_TIME if problem.autonomous else 1.0)
    later = evaluate(eqx.tree_at(lambda p: p.phase, problem, moved), point.x, point.period, point.values, dof)
    if not differs(point, later, scale):
        return
    if problem.autonomous:
        raise OrbitError(
            "The scene depends on time: a run from the same state at another time differs. Pass the period of its"
            " forces,"
            ' as in period=lambda p: 2 * jnp.pi / p["omega"].'
        )
    raise OrbitError(
        "The run does not continue as an orbit: the forces of the scene do not repeat after the period"
        f" {point.period:.6g} s. Pass a multiple of their period."
    )


def _refuse_family(problem: OrbitProblem, point: ShotOrbit, scale: np.ndarray, dof: int) -> None:
    """Check that the orbit is isolated, or that its neighbours are orbits to first order only.

    **Raises:**

    - `OrbitError` if a multiplier is 1 and a state a small distance along its direction returns as well.
    """
    by = point.scaled(scale)[0][:, : len(point.residual)]
    _, sizes, rows = np.linalg.svd(by)
    if sizes[-1] > _FAMILY * sizes[0]:
        return
    size, away = point.x.size, 1e-3 * rows[-1] * scale[: len(rows)]
    period = point.period + (away[size] if problem.autonomous else 0.0)
    beside = evaluate(problem, point.x + away[:size].reshape(point.x.shape), period, point.values, dof)
    # At a fold this residual would be of second order, 1e-6.
    if not beside.failure and np.max(np.abs(beside.residual[:size]) / scale[:size]) < 1e-8:
        raise OrbitError(
            "The orbit is one of a family: it has another multiplier of exactly 1, and the scene does not determine"
            " which orbit. Examples are conservative scenes, a bristle that never slips, and dry friction at certain"
            " frequencies. Add a little damping, or change the frequency."
        )


def _with_derivatives(
    problem: OrbitProblem, point: ShotOrbit, orbit: PeriodicOrbit, extrema: tuple[Extremes, Extremes]
) -> PeriodicOrbit:
    """The orbit with the derivatives of the implicit function theorem, by one step of Newton from the solution."""
    dof, size, scene, spans = orbit.q.shape[0], point.x.size, problem.scene, problem.spans
    inverse = np.linalg.inv(point.by[:, : len(point.residual)])
    x, period = jnp.asarray(point.x), jnp.asarray(point.period)
    after = [
        end_of(run_segment(problem, scene, y, problem.period_of(scene, period), span, dof))
        for y, span in zip(x, spans, strict=True)
    ]
    miss = jnp.stack(after) - jnp.roll(x, -1, axis=0)
    residual = jnp.ravel(miss.at[-1].set(problem.closure(x[0], after[-1])))
    if problem.autonomous:
        residual = jnp.append(residual, 0.0)
    unknowns = jnp.asarray(inverse) @ residual
    change = jax.lax.stop_gradient(unknowns) - unknowns
    x = x + change[:size].reshape(x.shape)
    period = period + change[size] if problem.autonomous else problem.period_of(scene, period)
    times, acceleration = (np.concatenate(x) for x in ([x.time for x in extrema], [x.acceleration for x in extrema]))
    struck = [name for x in extrema for name in x.struck]
    order = np.argsort(times, kind="stable")
    place = np.argsort(order, kind="stable"), np.tile(np.arange(dof), 2)
    extremes, end = jnp.zeros(len(times)), x[0]
    for y, span in zip(x, spans, strict=True):
        run = run_segment(problem, scene, y, period, span, dof, jnp.asarray([*times[order], np.inf]))
        end = end_of(run)
        # The times are approximate: a parabola leads from the state at that time to the extremum.
        extremum = run.q[place] - 0.5 * run.qd[place] ** 2 / acceleration
        for i, name in enumerate(struck):
            if name:
                q, qd = run.q[place[0][i]], run.qd[place[0][i]]
                extremum = extremum.at[i].add(_to_impact(scene, name, times[i], q, qd)[i % dof])
        extremes = jnp.where(times >= float(span[0]) * point.period, extremum, extremes)
    lowest, highest = (
        value + (x - jax.lax.stop_gradient(x))
        for value, x in zip((orbit.lowest, orbit.highest), extremes.reshape(2, dof), strict=True)
    )
    q, qd, z = unpack(scene, x[0], dof)
    advance = (problem.free @ (end - x[0]))[:dof]
    return replace(orbit, q=q, qd=qd, z=z, period=period, lowest=lowest, highest=highest, advance=advance)


def _to_impact(scene: Scene, name: str, t: float, q: Array, qd: Array) -> Array:
    """Displacement from a state just before an impact to it, with the derivative of the time of the impact."""
    contact, params, time = scene.contacts[name], scene.bind_time(jnp.asarray(t)).params, jnp.asarray(t)
    return -qd * contact.error(time, q, params)[0] / contact.rate(time, q, qd, params)[0]
